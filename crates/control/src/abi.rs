//! What crosses the C interface, and its four functions.
//!
//! Python (`actrm_harness.control`) mirrors [`Binding`] and [`State`] as ctypes structures;
//! [`control_abi`] lets it check that both sides mean the same. Raise [`ABI`] with every change.

use std::ffi::c_void;

use crate::osc::{Arm, DOF, Gains, Pose, clip};
use crate::rotation::delta_rotation;
use crate::substeps::{JacSiteFunction, Loop, PolicyArm, Status, StepFunction};

/// Version of this interface.
const ABI: u64 = 2;

/// What the loop reads and writes of one simulation, as addresses into the arrays of its `mjModel`
/// and `mjData`; where a robot is in them, its [`ArmBinding`] says.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// `mj_step1`.
    pub step1: Option<StepFunction>,
    /// `mj_step2`.
    pub step2: Option<StepFunction>,
    /// `mj_jacSite`.
    pub jac_site: Option<JacSiteFunction>,
    /// The `mjModel`.
    pub model: *const c_void,
    /// The `mjData`.
    pub data: *mut c_void,
    /// `nu` controls.
    pub ctrl: *mut f64,
    /// `nq` positions.
    pub qpos: *const f64,
    /// `nv` velocities.
    pub qvel: *const f64,
    /// The sparse inertia matrix, `nm` numbers.
    pub qm: *const f64,
    /// `nv` Coriolis, centrifugal and gravity forces.
    pub qfrc_bias: *const f64,
    /// `nsite` by 3 positions.
    pub site_xpos: *const f64,
    /// `nsite` by 9 orientations.
    pub site_xmat: *const f64,
    /// `nu` by 2 limits of controls.
    pub ctrlrange: *const f64,
    /// `nv` addresses of diagonals in `qm`.
    pub dof_madr: *const i32,
    /// `nv` parents in the kinematic tree, -1 for none.
    pub dof_parent: *const i32,
    /// Positions.
    pub nq: i32,
    /// Degrees of freedom.
    pub nv: i32,
    /// Actuators.
    pub nu: i32,
    /// Numbers in the sparse inertia matrix.
    pub nm: i32,
    /// Sites.
    pub nsite: i32,
}

/// Where a robot of one arm is in the simulation, and how it is controlled.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct ArmBinding {
    /// The site that the arm controller moves.
    pub grip_site: i32,
    /// The site whose frame goals are given in; its body must not move.
    pub origin_site: i32,
    /// Where the arm's joints are in `qpos`.
    pub arm_qpos: [i32; DOF],
    /// Where the arm's joints are in `qvel`.
    pub arm_dof: [i32; DOF],
    /// The arm's actuators.
    pub arm_actuator: [i32; DOF],
    /// The gripper's actuators.
    pub gripper_actuator: [i32; 2],
    /// How many of them there are: two, or none of a hand without fingers.
    pub fingers: i32,
    /// The arm controller's configuration.
    pub gains: Gains,
    /// The gripper's configuration.
    pub gripper: Gripper,
}

/// Numbers of an action for an arm: translation and rotation.
const ARM_ACTION: usize = 6;

impl ArmBinding {
    /// How many numbers of an action are this robot's.
    pub fn action(&self) -> usize {
        ARM_ACTION + usize::from(self.fingers != 0)
    }

    /// Checks the indices against the sizes of a simulation.
    pub(crate) fn check(&self, sizes: &Binding) -> Result<(), Status> {
        let within = |indices: &[i32], size: i32| indices.iter().all(|&i| 0 <= i && i < size);
        let fingers = match self.fingers {
            0 => true,
            2 => within(&self.gripper_actuator, sizes.nu),
            _ => false,
        };
        let good = fingers
            && within(&self.arm_qpos, sizes.nq)
            && within(&self.arm_dof, sizes.nv)
            && within(&self.arm_actuator, sizes.nu)
            && within(&[self.grip_site, self.origin_site], sizes.nsite);
        if good { Ok(()) } else { Err(Status::BadArgument) }
    }
}

/// A two-finger gripper that integrates the sign of its action.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Gripper {
    /// Change of the fingers' command per control step.
    pub speed: f64,
    /// Which way each finger goes for a positive action: -1 or 1.
    pub direction: [f64; 2],
    /// Commands are clipped to at least this.
    pub input_min: [f64; 2],
    /// Commands are clipped to at most this.
    pub input_max: [f64; 2],
    /// Subtracted from a clipped command.
    pub input_offset: [f64; 2],
    /// Multiplied with what remains.
    pub scale: [f64; 2],
    /// Added to the product: the goal.
    pub output_offset: [f64; 2],
    /// Middle of the actuator's range.
    pub bias: [f64; 2],
    /// Half of the actuator's range; the control is `bias + weight * goal`.
    pub weight: [f64; 2],
}

impl Gripper {
    /// The goal of a finger whose command is `command`.
    pub(crate) fn scaled(&self, finger: usize, command: f64) -> f64 {
        let clipped = clip(command, self.input_min[finger], self.input_max[finger]);
        (clipped - self.input_offset[finger]) * self.scale[finger] + self.output_offset[finger]
    }
}

/// The memory of one robot's controllers. Python owns it; the attributes of robosuite's controllers are views
/// into it, so that both sides see the same state at any time.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// What the arm controller knows of the arm.
    pub arm: Arm,
    /// The frame of goals.
    pub origin: Pose,
    /// The arm's goal, in that frame.
    pub goal: Pose,
    /// The arm's torques of the last substep, before clipping.
    pub torques: [f64; DOF],
    /// The fingers' integrated commands.
    pub gripper_action: [f64; 2],
    /// The fingers' goals.
    pub gripper_goal: [f64; 2],
    /// The arm when goals were last set.
    pub policy_arm: PolicyArm,
    /// Zero until the first substep after a reset has used the controller's old snapshot.
    pub new_update: u64,
}

impl Binding {
    /// Checks pointers and functions.
    pub(crate) fn check(&self) -> Result<(), Status> {
        let pointers = [
            self.model,
            self.data.cast_const(),
            self.ctrl.cast_const().cast(),
            self.qpos.cast(),
            self.qvel.cast(),
            self.qm.cast(),
            self.qfrc_bias.cast(),
            self.site_xpos.cast(),
            self.site_xmat.cast(),
            self.ctrlrange.cast(),
            self.dof_madr.cast(),
            self.dof_parent.cast(),
        ];
        let functions = self.step1.is_some() && self.step2.is_some() && self.jac_site.is_some();
        let good = functions && pointers.iter().all(|p| !p.is_null());
        if good { Ok(()) } else { Err(Status::BadArgument) }
    }

    /// An arm's block of the inertia matrix: what `mj_fullM` gives on its rows and columns.
    ///
    /// # Safety
    /// The arrays must be those of a live simulation of the given sizes, and `arm_dof` below `nv`.
    pub(crate) unsafe fn arm_mass(&self, arm_dof: &[i32; DOF]) -> [[f64; DOF]; DOF] {
        let mut mass = [[0.0; DOF]; DOF];
        for (row, &dof) in arm_dof.iter().enumerate() {
            // SAFETY: dof is below nv, and a row's ancestors follow its diagonal in qm
            unsafe {
                let mut address = *self.dof_madr.add(dof as usize);
                let mut ancestor = dof;
                while ancestor >= 0 && 0 <= address && address < self.nm {
                    if let Some(column) = arm_dof.iter().position(|&d| d == ancestor) {
                        let value = *self.qm.add(address as usize);
                        mass[row][column] = value;
                        mass[column][row] = value;
                    }
                    ancestor = *self.dof_parent.add(ancestor as usize);
                    address += 1;
                }
            }
        }
        mass
    }

    /// Writes a control, clipped to its actuator's range.
    ///
    /// # Safety
    /// `actuator` must be below `nu`, and the arrays live.
    pub(crate) unsafe fn write_ctrl(&self, actuator: i32, value: f64) {
        let actuator = actuator as usize;
        // SAFETY: the caller vouches for the index
        unsafe {
            let (low, high) = (*self.ctrlrange.add(2 * actuator), *self.ctrlrange.add(2 * actuator + 1));
            *self.ctrl.add(actuator) = clip(value, low, high);
        }
    }
}

/// The interface's version and the sizes of [`Binding`], [`ArmBinding`] and [`State`], 16 bits each from the
/// top: one number to compare before anything else is called.
#[unsafe(no_mangle)]
pub extern "C" fn control_abi() -> u64 {
    [size_of::<Binding>(), size_of::<ArmBinding>(), size_of::<State>()]
        .iter()
        .fold(ABI, |number, &size| (number << 16) | size as u64)
}

/// Checks a binding and `count` robots in it, and returns a loop over them, or null if they are not sound.
///
/// # Safety
/// `binding` must be null or point to a [`Binding`], `arms` null or to `count` of [`ArmBinding`].
#[unsafe(no_mangle)]
pub unsafe extern "C" fn control_open(binding: *const Binding, arms: *const ArmBinding, count: u32) -> *mut Loop {
    // SAFETY: the caller vouches for the pointer
    let Some(binding) = (unsafe { binding.as_ref() }).filter(|_| !arms.is_null()) else {
        return std::ptr::null_mut();
    };
    // SAFETY: not null, and the caller vouches for the rest
    let arms = unsafe { std::slice::from_raw_parts(arms, count as usize) };
    match Loop::new(*binding, arms) {
        Ok(made) => Box::into_raw(Box::new(made)),
        Err(_) => std::ptr::null_mut(),
    }
}

/// Takes `substeps` substeps; the first sets the goals from `action` if `policy_step` is not zero.
/// Returns a [`Status`].
///
/// # Safety
/// `handle` must come from [`control_open`] and not be closed, `states` and `action` must be null or point
/// to a [`State`] for each robot and to the numbers of all robots' actions one after the other, and the
/// simulation behind the binding must be alive and used by nobody else meanwhile.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn control_run(
    handle: *mut Loop,
    states: *mut State,
    action: *const f64,
    substeps: u32,
    policy_step: u32,
) -> i32 {
    // SAFETY: the caller vouches for the handle
    let Some(handle) = (unsafe { handle.as_mut() }).filter(|_| !states.is_null() && !action.is_null()) else {
        return Status::BadArgument as i32;
    };
    // SAFETY: not null, and the caller vouches for their lengths and for the simulation
    unsafe {
        let states = std::slice::from_raw_parts_mut(states, handle.robots());
        let action = std::slice::from_raw_parts(action, handle.action());
        handle.run(states, action, substeps, policy_step != 0) as i32
    }
}

/// Frees a loop; null is allowed.
///
/// # Safety
/// `handle` must be null or come from [`control_open`], and must not be used afterwards.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn control_close(handle: *mut Loop) {
    if !handle.is_null() {
        // SAFETY: it was made by Box::into_raw and is given up by the caller
        drop(unsafe { Box::from_raw(handle) });
    }
}

/// Writes the matrix of a scaled axis as the controller computes it (nine numbers, row-major), so
/// that its single-precision rounding can be compared with robosuite's bit by bit.
///
/// # Safety
/// `axis` must point to three numbers, `out` to room for nine.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn control_delta_rotation(axis: *const [f64; 3], out: *mut [[f64; 3]; 3]) {
    // SAFETY: the caller vouches for the pointers
    if let (Some(axis), Some(out)) = unsafe { (axis.as_ref(), out.as_mut()) } {
        *out = delta_rotation(*axis);
    }
}
