//! The loop itself: `mj_step1`, torques, `mj_step2`, as often as asked.

use std::ffi::c_void;

use crate::abi::{Binding, State};
use crate::osc::{self, DOF};

/// How a run ended.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// All substeps were taken.
    Done = 0,
    /// The arm's inertia matrix is not positive definite: the simulation has diverged.
    Diverged = 1,
    /// A pointer is null, a size is not positive or an index is out of range.
    BadArgument = 2,
}

/// A binding that has been checked, with room for Jacobians.
pub struct Loop {
    binding: Binding,
    jacp: Vec<f64>,
    jacr: Vec<f64>,
}

impl Loop {
    /// Takes a binding over; refuses one whose indices do not fit its sizes.
    pub fn new(binding: Binding) -> Result<Self, Status> {
        binding.check()?;
        let room = 3 * binding.nv as usize;
        Ok(Self { binding, jacp: vec![0.0; room], jacr: vec![0.0; room] })
    }

    /// Takes `substeps` substeps. With `policy_step` the first of them sets the goals from
    /// `action` (six numbers for the arm, one for the gripper).
    ///
    /// # Safety
    /// The binding's model, data, arrays and functions must be those of one live simulation
    /// that nobody else touches during the call.
    pub unsafe fn run(&mut self, state: &mut State, action: &[f64; 7], substeps: u32, policy_step: bool) -> Status {
        let (model, data) = (self.binding.model, self.binding.data);
        let (Some(step1), Some(step2)) = (self.binding.step1, self.binding.step2) else {
            return Status::BadArgument;
        };
        for substep in 0..substeps {
            // SAFETY: the caller vouches for model, data and the function; see above
            unsafe { step1(model, data) };
            // SAFETY: as above
            if unsafe { self.control(state, action, policy_step && substep == 0) }.is_none() {
                return Status::Diverged;
            }
            // SAFETY: as above
            unsafe { step2(model, data) };
        }
        Status::Done
    }

    /// Writes the controls of one substep; `None` if the arm's inertia makes no sense.
    ///
    /// # Safety
    /// As for [`Loop::run`].
    unsafe fn control(&mut self, state: &mut State, action: &[f64; 7], set_goal: bool) -> Option<()> {
        let b = &self.binding;
        let origin = b.origin_site as usize;
        // SAFETY: site indices were checked against nsite, whose arrays these are
        unsafe {
            state.origin.pos = std::array::from_fn(|i| *b.site_xpos.add(3 * origin + i));
            state.origin.ori = read_mat3(b.site_xmat.add(9 * origin));
        }
        if state.new_update != 0 {
            // SAFETY: the caller vouches for the binding
            unsafe { self.refresh(state) };
        }
        let b = &self.binding;
        if set_goal {
            let arm_action = std::array::from_fn(|i| action[i]);
            state.goal = osc::goal(&b.gains, &arm_action, &state.arm, &state.origin);
            let step = b.gripper.speed * sign(action[6]);
            for i in 0..2 {
                let moved = state.gripper_action[i] + b.gripper.direction[i] * step;
                state.gripper_action[i] = osc::clip(moved, -1.0, 1.0);
                state.gripper_goal[i] = b.gripper.scaled(i, state.gripper_action[i]);
            }
            state.policy_arm = PolicyArm::of(state);
        }
        // SAFETY: indices of degrees of freedom were checked against nv
        let bias = b.arm_dof.map(|dof| unsafe { *b.qfrc_bias.add(dof as usize) });
        state.torques = osc::torques(&b.gains, &state.arm, &state.origin, &state.goal, &bias)?;
        for i in 0..DOF {
            // SAFETY: indices of actuators were checked against nu
            unsafe { b.write_ctrl(b.arm_actuator[i], state.torques[i]) };
        }
        for i in 0..2 {
            let ctrl = b.gripper.bias[i] + b.gripper.weight[i] * state.gripper_goal[i];
            // SAFETY: as above
            unsafe { b.write_ctrl(b.gripper_actuator[i], ctrl) };
        }
        state.new_update = 1;
        Some(())
    }

    /// Reads the arm's state out of the simulator.
    ///
    /// # Safety
    /// As for [`Loop::run`].
    unsafe fn refresh(&mut self, state: &mut State) {
        let b = &self.binding;
        let site = b.grip_site as usize;
        let nv = b.nv as usize;
        let arm = &mut state.arm;
        // SAFETY: indices were checked against the sizes of these arrays; the scratch arrays
        // have room for three rows of nv
        unsafe {
            arm.ref_pos = std::array::from_fn(|i| *b.site_xpos.add(3 * site + i));
            arm.ref_ori = read_mat3(b.site_xmat.add(9 * site));
            if let Some(jac_site) = b.jac_site {
                jac_site(b.model, b.data, self.jacp.as_mut_ptr(), self.jacr.as_mut_ptr(), b.grip_site);
            }
            let qvel = std::slice::from_raw_parts(b.qvel, nv);
            for i in 0..3 {
                arm.ref_pos_vel[i] = dot(&self.jacp[i * nv..(i + 1) * nv], qvel);
                arm.ref_ori_vel[i] = dot(&self.jacr[i * nv..(i + 1) * nv], qvel);
            }
            for (j, &dof) in b.arm_dof.iter().enumerate() {
                let dof = dof as usize;
                for i in 0..3 {
                    arm.jacobian[i][j] = self.jacp[i * nv + dof];
                    arm.jacobian[3 + i][j] = self.jacr[i * nv + dof];
                }
                arm.joint_pos[j] = *b.qpos.add(b.arm_qpos[j] as usize);
                arm.joint_vel[j] = qvel[dof];
            }
            arm.mass = b.arm_mass();
        }
    }
}

/// The arm as it was when goals were last set: what robosuite pushes into its `recent_*` buffers.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct PolicyArm {
    /// Position of the grip site.
    pub ref_pos: [f64; 3],
    /// Orientation of the grip site.
    pub ref_ori: crate::rotation::Mat3,
    /// Velocity of the grip site.
    pub ref_pos_vel: [f64; 3],
    /// Angular velocity of the grip site.
    pub ref_ori_vel: [f64; 3],
}

impl PolicyArm {
    fn of(state: &State) -> Self {
        Self {
            ref_pos: state.arm.ref_pos,
            ref_ori: state.arm.ref_ori,
            ref_pos_vel: state.arm.ref_pos_vel,
            ref_ori_vel: state.arm.ref_ori_vel,
        }
    }
}

/// `numpy.sign`: zero and NaN stay what they are.
fn sign(x: f64) -> f64 {
    if x > 0.0 {
        1.0
    } else if x < 0.0 {
        -1.0
    } else {
        x
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// # Safety
/// Nine numbers must be readable at `at`.
unsafe fn read_mat3(at: *const f64) -> crate::rotation::Mat3 {
    // SAFETY: the caller vouches for nine numbers
    std::array::from_fn(|i| std::array::from_fn(|j| unsafe { *at.add(3 * i + j) }))
}

/// `mj_step1` or `mj_step2`.
pub type StepFunction = unsafe extern "C" fn(*const c_void, *mut c_void);

/// `mj_jacSite`.
pub type JacSiteFunction = unsafe extern "C" fn(*const c_void, *const c_void, *mut f64, *mut f64, i32);
