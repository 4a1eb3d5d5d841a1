//! The loop itself: `mj_step1`, torques, `mj_step2`, as often as asked.

use std::ffi::c_void;

use crate::abi::{ArmBinding, Binding, State};
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

/// A binding and the robots in it, checked, with room for Jacobians.
pub struct Loop {
    binding: Binding,
    arms: Vec<ArmBinding>,
    jacp: Vec<f64>,
    jacr: Vec<f64>,
}

impl Loop {
    /// Takes a binding and its robots over; refuses indices that do not fit its sizes, and no robot at all.
    pub fn new(binding: Binding, arms: &[ArmBinding]) -> Result<Self, Status> {
        binding.check()?;
        if arms.is_empty() {
            return Err(Status::BadArgument);
        }
        arms.iter().try_for_each(|arm| arm.check(&binding))?;
        let room = 3 * binding.nv as usize;
        Ok(Self { binding, arms: arms.to_vec(), jacp: vec![0.0; room], jacr: vec![0.0; room] })
    }

    /// How many robots there are, each with one arm.
    pub fn robots(&self) -> usize {
        self.arms.len()
    }

    /// How many numbers an action has, all robots' together.
    pub fn action(&self) -> usize {
        self.arms.iter().map(ArmBinding::action).sum()
    }

    /// Takes `substeps` substeps. With `policy_step` the first of them sets the goals from `action`: for
    /// each robot six numbers for the arm, and one for the gripper if it has fingers.
    ///
    /// # Safety
    /// The binding's model, data, arrays and functions must be those of one live simulation
    /// that nobody else touches during the call.
    pub unsafe fn run(&mut self, states: &mut [State], action: &[f64], substeps: u32, policy_step: bool) -> Status {
        let (model, data) = (self.binding.model, self.binding.data);
        let (Some(step1), Some(step2)) = (self.binding.step1, self.binding.step2) else {
            return Status::BadArgument;
        };
        if states.len() != self.robots() || action.len() != self.action() {
            return Status::BadArgument;
        }
        for substep in 0..substeps {
            // SAFETY: the caller vouches for model, data and the function; see above
            unsafe { step1(model, data) };
            let mut rest = action;
            for (robot, state) in states.iter_mut().enumerate() {
                let (own, others) = rest.split_at(self.arms[robot].action());
                rest = others;
                let goal = (policy_step && substep == 0).then_some(own);
                // SAFETY: as above
                if unsafe { self.control(robot, state, goal) }.is_none() {
                    return Status::Diverged;
                }
            }
            // SAFETY: as above
            unsafe { step2(model, data) };
        }
        Status::Done
    }

    /// Writes a robot's controls of one substep, after setting its goals from its part of an action, if
    /// there is one; `None` if the arm's inertia makes no sense.
    ///
    /// # Safety
    /// As for [`Loop::run`].
    unsafe fn control(&mut self, robot: usize, state: &mut State, action: Option<&[f64]>) -> Option<()> {
        let (b, arm) = (&self.binding, self.arms[robot]);
        let origin = arm.origin_site as usize;
        // SAFETY: site indices were checked against nsite, whose arrays these are
        unsafe {
            state.origin.pos = std::array::from_fn(|i| *b.site_xpos.add(3 * origin + i));
            state.origin.ori = read_mat3(b.site_xmat.add(9 * origin));
        }
        if state.new_update != 0 {
            // SAFETY: the caller vouches for the binding
            unsafe { self.refresh(&arm, state) };
        }
        let b = &self.binding;
        if let Some(action) = action {
            let arm_action = std::array::from_fn(|i| action[i]);
            state.goal = osc::goal(&arm.gains, &arm_action, &state.arm, &state.origin);
            if let Some(&grip) = action.get(6) {
                let step = arm.gripper.speed * sign(grip);
                for i in 0..2 {
                    let moved = state.gripper_action[i] + arm.gripper.direction[i] * step;
                    state.gripper_action[i] = osc::clip(moved, -1.0, 1.0);
                    state.gripper_goal[i] = arm.gripper.scaled(i, state.gripper_action[i]);
                }
            }
            state.policy_arm = PolicyArm::of(state);
        }
        // SAFETY: indices of degrees of freedom were checked against nv
        let bias = arm.arm_dof.map(|dof| unsafe { *b.qfrc_bias.add(dof as usize) });
        state.torques = osc::torques(&arm.gains, &state.arm, &state.origin, &state.goal, &bias)?;
        for i in 0..DOF {
            // SAFETY: indices of actuators were checked against nu
            unsafe { b.write_ctrl(arm.arm_actuator[i], state.torques[i]) };
        }
        for i in 0..arm.fingers as usize {
            let ctrl = arm.gripper.bias[i] + arm.gripper.weight[i] * state.gripper_goal[i];
            // SAFETY: as above
            unsafe { b.write_ctrl(arm.gripper_actuator[i], ctrl) };
        }
        state.new_update = 1;
        Some(())
    }

    /// Reads an arm's state out of the simulator.
    ///
    /// # Safety
    /// As for [`Loop::run`].
    unsafe fn refresh(&mut self, of: &ArmBinding, state: &mut State) {
        let b = &self.binding;
        let site = of.grip_site as usize;
        let nv = b.nv as usize;
        let arm = &mut state.arm;
        // SAFETY: indices were checked against the sizes of these arrays; the scratch arrays
        // have room for three rows of nv
        unsafe {
            arm.ref_pos = std::array::from_fn(|i| *b.site_xpos.add(3 * site + i));
            arm.ref_ori = read_mat3(b.site_xmat.add(9 * site));
            if let Some(jac_site) = b.jac_site {
                jac_site(b.model, b.data, self.jacp.as_mut_ptr(), self.jacr.as_mut_ptr(), of.grip_site);
            }
            let qvel = std::slice::from_raw_parts(b.qvel, nv);
            for i in 0..3 {
                arm.ref_pos_vel[i] = dot(&self.jacp[i * nv..(i + 1) * nv], qvel);
                arm.ref_ori_vel[i] = dot(&self.jacr[i * nv..(i + 1) * nv], qvel);
            }
            for (j, &dof) in of.arm_dof.iter().enumerate() {
                let dof = dof as usize;
                for i in 0..3 {
                    arm.jacobian[i][j] = self.jacp[i * nv + dof];
                    arm.jacobian[3 + i][j] = self.jacr[i * nv + dof];
                }
                arm.joint_pos[j] = *b.qpos.add(of.arm_qpos[j] as usize);
                arm.joint_vel[j] = qvel[dof];
            }
            arm.mass = b.arm_mass(&of.arm_dof);
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

#[cfg(test)]
mod tests {
    use std::slice;

    use super::*;
    use crate::abi::{Gripper, control_close, control_open, control_run};
    use crate::osc::{Arm, Gains, Pose};

    const NV: usize = 9;
    const IDENTITY: crate::rotation::Mat3 = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    /// A simulation that counts its calls: a chain of nine joints, of which the arm has seven.
    struct Fake {
        log: Vec<u8>,
        ctrl: [f64; NV],
        qpos: [f64; NV],
        qvel: [f64; NV],
        qm: Vec<f64>,
        bias: [f64; NV],
        site_xpos: [f64; 6],
        site_xmat: [f64; 18],
        range: [f64; 2 * NV],
        madr: [i32; NV],
        parent: [i32; NV],
        dense: [[f64; NV]; NV],
    }

    unsafe extern "C" fn step1(_: *const c_void, data: *mut c_void) {
        // SAFETY: the tests bind a Fake as data
        let fake = unsafe { &mut *data.cast::<Fake>() };
        fake.log.push(1);
        // what a real step1 does as well: positions become poses
        fake.site_xpos[3] = fake.qpos[0];
    }

    unsafe extern "C" fn step2(_: *const c_void, data: *mut c_void) {
        // SAFETY: as in step1
        let fake = unsafe { &mut *data.cast::<Fake>() };
        fake.log.push(2);
        fake.qpos[0] += 0.001;
    }

    unsafe extern "C" fn jac_site(_: *const c_void, data: *const c_void, p: *mut f64, r: *mut f64, site: i32) {
        // SAFETY: as in step1; the loop gives room for three rows of NV
        unsafe {
            (*data.cast_mut().cast::<Fake>()).log.push(10 + site as u8);
            for i in 0..3 * NV {
                *p.add(i) = ((i * 7 + 3) % 11) as f64 / 10.0;
                *r.add(i) = ((i * 5 + 1) % 13) as f64 / 12.0;
            }
        }
    }

    impl Fake {
        fn new() -> Box<Self> {
            let mut dense = [[0.0; NV]; NV];
            for i in 0..NV {
                for j in 0..NV {
                    dense[i][j] = 1.0 / (1.0 + i.abs_diff(j) as f64) + if i == j { 1.0 } else { 0.0 };
                }
            }
            // MuJoCo's order: the diagonal, then the ancestors upwards
            let (mut qm, mut madr) = (Vec::new(), [0; NV]);
            for i in 0..NV {
                madr[i] = qm.len() as i32;
                (0..=i).rev().for_each(|j| qm.push(dense[i][j]));
            }
            let mut site_xmat = [0.0; 18];
            IDENTITY
                .as_flattened()
                .iter()
                .chain(IDENTITY.as_flattened())
                .zip(&mut site_xmat)
                .for_each(|(a, b)| *b = *a);
            Box::new(Self {
                log: Vec::new(),
                ctrl: [0.0; NV],
                qpos: std::array::from_fn(|i| 0.1 * i as f64),
                qvel: std::array::from_fn(|i| 0.01 * i as f64),
                qm,
                bias: std::array::from_fn(|i| i as f64),
                site_xpos: [0.0, 0.0, 0.9, 0.4, 0.0, 1.0],
                site_xmat,
                range: std::array::from_fn(|i| if i % 2 == 0 { -80.0 } else { 80.0 }),
                madr,
                parent: std::array::from_fn(|i| i as i32 - 1),
                dense,
            })
        }

        fn bind(&mut self) -> Binding {
            let data: *mut Self = self;
            Binding {
                step1: Some(step1),
                step2: Some(step2),
                jac_site: Some(jac_site),
                model: data.cast_const().cast(),
                data: data.cast(),
                ctrl: self.ctrl.as_mut_ptr(),
                qpos: self.qpos.as_ptr(),
                qvel: self.qvel.as_ptr(),
                qm: self.qm.as_ptr(),
                qfrc_bias: self.bias.as_ptr(),
                site_xpos: self.site_xpos.as_ptr(),
                site_xmat: self.site_xmat.as_ptr(),
                ctrlrange: self.range.as_ptr(),
                dof_madr: self.madr.as_ptr(),
                dof_parent: self.parent.as_ptr(),
                nq: NV as i32,
                nv: NV as i32,
                nu: NV as i32,
                nm: self.qm.len() as i32,
                nsite: 2,
            }
        }

        /// The robot of the first seven joints, with the last two as fingers.
        fn arm() -> ArmBinding {
            ArmBinding {
                grip_site: 1,
                origin_site: 0,
                arm_qpos: [0, 1, 2, 3, 4, 5, 6],
                arm_dof: [0, 1, 2, 3, 4, 5, 6],
                arm_actuator: [0, 1, 2, 3, 4, 5, 6],
                gripper_actuator: [7, 8],
                fingers: 2,
                gains: Gains {
                    kp: [150.0; 6],
                    kd: [2.0 * 150.0_f64.sqrt(); 6],
                    input_min: [-1.0; 6],
                    input_max: [1.0; 6],
                    input_offset: [0.0; 6],
                    scale: [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
                    output_offset: [0.0; 6],
                    initial_joint: [0.0; DOF],
                },
                gripper: Gripper {
                    speed: 0.2,
                    direction: [-1.0, 1.0],
                    input_min: [-1.0; 2],
                    input_max: [1.0; 2],
                    input_offset: [0.0; 2],
                    scale: [1.0; 2],
                    output_offset: [0.0; 2],
                    bias: [0.02, -0.02],
                    weight: [0.02, 0.02],
                },
            }
        }
    }

    fn state(new_update: u64) -> State {
        let arm = Arm {
            ref_pos: [0.3, 0.0, 1.1],
            ref_ori: IDENTITY,
            ref_pos_vel: [0.0; 3],
            ref_ori_vel: [0.0; 3],
            joint_pos: [0.5; DOF],
            joint_vel: [0.0; DOF],
            mass: std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)))),
            jacobian: std::array::from_fn(|i| std::array::from_fn(|j| ((i * 3 + j * 5) % 7) as f64 / 7.0)),
        };
        let pose = Pose { pos: [0.0; 3], ori: IDENTITY };
        let policy_arm =
            PolicyArm { ref_pos: [0.0; 3], ref_ori: IDENTITY, ref_pos_vel: [0.0; 3], ref_ori_vel: [0.0; 3] };
        State {
            arm,
            origin: pose,
            goal: pose,
            torques: [0.0; DOF],
            gripper_action: [0.0; 2],
            gripper_goal: [0.0; 2],
            policy_arm,
            new_update,
        }
    }

    const ACTION: [f64; 7] = [0.4, 0.0, -0.2, 0.0, 0.1, 0.0, 1.0];

    #[test]
    fn substeps_alternate_and_the_arm_is_read_between_them() {
        let mut fake = Fake::new();
        let mut made = Loop::new(fake.bind(), &[Fake::arm()]).expect("sound");
        let mut state = state(1);
        // SAFETY: the fake outlives the loop
        let status = unsafe { made.run(slice::from_mut(&mut state), &ACTION, 3, true) };
        assert_eq!(status, Status::Done);
        assert_eq!(fake.log, [1, 11, 2, 1, 11, 2, 1, 11, 2]);
        assert_eq!(state.arm.ref_pos, [fake.qpos[0] - 0.001, 0.0, 1.0]);
        for i in 0..DOF {
            assert_eq!(state.arm.mass[i], fake.dense[i][..DOF]);
        }
        assert_eq!(state.policy_arm.ref_pos, [0.0, 0.0, 1.0]);
        assert_eq!(state.origin.pos, [0.0, 0.0, 0.9]);
        assert_eq!(state.new_update, 1);
    }

    #[test]
    fn the_first_substep_after_a_reset_uses_the_old_snapshot_and_the_live_bias() {
        let mut fake = Fake::new();
        let gains = Fake::arm().gains;
        let mut made = Loop::new(fake.bind(), &[Fake::arm()]).expect("sound");
        let mut state = state(0);
        let snapshot = state.arm;
        // SAFETY: the fake outlives the loop
        unsafe { made.run(slice::from_mut(&mut state), &ACTION, 1, true) };
        assert_eq!(fake.log, [1, 2], "the Jacobian is not asked for");
        let origin = Pose { pos: [0.0, 0.0, 0.9], ori: IDENTITY };
        let arm_action = [0.4, 0.0, -0.2, 0.0, 0.1, 0.0];
        let goal = osc::goal(&gains, &arm_action, &snapshot, &origin);
        let bias = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let expected = osc::torques(&gains, &snapshot, &origin, &goal, &bias).expect("regular");
        assert_eq!(state.torques, expected);
        // SAFETY: as above
        unsafe { made.run(slice::from_mut(&mut state), &ACTION, 1, false) };
        assert_ne!(state.arm.ref_pos, snapshot.ref_pos);
    }

    #[test]
    fn the_gripper_moves_once_a_control_step_and_stops_at_its_limits() {
        let mut fake = Fake::new();
        let mut made = Loop::new(fake.bind(), &[Fake::arm()]).expect("sound");
        let mut state = state(1);
        // commands after each control step: 0.2 a step, whatever the size of the action
        for (action, expected) in [(1.0, 0.2), (0.01, 0.4), (0.0, 0.4), (-0.5, 0.2)] {
            let full = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, action];
            // SAFETY: the fake outlives the loop
            unsafe { made.run(slice::from_mut(&mut state), &full, 25, true) };
            assert!((state.gripper_action[1] - expected).abs() < 1e-15, "{:?}", state.gripper_action);
            assert_eq!(state.gripper_action[0], -state.gripper_action[1]);
            assert_eq!(fake.ctrl[7], 0.02 + 0.02 * state.gripper_action[0]);
            assert_eq!(fake.ctrl[8], -0.02 + 0.02 * state.gripper_action[1]);
        }
        for _ in 0..20 {
            // SAFETY: as above
            unsafe { made.run(slice::from_mut(&mut state), &ACTION, 1, true) };
        }
        assert_eq!(state.gripper_action, [-1.0, 1.0]);
        assert_eq!(fake.ctrl[7..], [0.0, 0.0]);
    }

    #[test]
    fn controls_stay_within_the_actuators_ranges() {
        let mut fake = Fake::new();
        fake.bias[2] = 1e4;
        fake.bias[3] = -1e4;
        let mut made = Loop::new(fake.bind(), &[Fake::arm()]).expect("sound");
        let mut state = state(1);
        // SAFETY: the fake outlives the loop
        unsafe { made.run(slice::from_mut(&mut state), &ACTION, 1, true) };
        assert_eq!((fake.ctrl[2], fake.ctrl[3]), (80.0, -80.0));
        assert!(state.torques[2] > 80.0);
    }

    #[test]
    fn a_diverged_simulation_is_reported() {
        let mut fake = Fake::new();
        fake.qm[0] = f64::NAN;
        let mut made = Loop::new(fake.bind(), &[Fake::arm()]).expect("sound");
        // SAFETY: the fake outlives the loop
        assert_eq!(unsafe { made.run(&mut [state(1)], &ACTION, 5, true) }, Status::Diverged);
        assert_eq!(fake.log, [1, 11], "nothing runs on");
    }

    #[test]
    fn robots_take_their_parts_of_an_action_in_turn() {
        let handless = ArmBinding { fingers: 0, ..Fake::arm() };
        let both = [0.4, 0.0, -0.2, 0.0, 0.1, 0.0, -0.3, 0.1, 0.2, 0.0, 0.0, 0.2, -1.0];
        let mut fake = Fake::new();
        let mut made = Loop::new(fake.bind(), &[handless, Fake::arm()]).expect("sound");
        assert_eq!((made.robots(), made.action()), (2, 13));
        let mut states = [state(1), state(1)];
        // SAFETY: the fake outlives the loop
        assert_eq!(unsafe { made.run(&mut states, &both, 2, true) }, Status::Done);
        assert_eq!(fake.log, [1, 11, 11, 2, 1, 11, 11, 2], "each arm is read in every substep");
        for (of, own) in [(0, &both[..6]), (1, &both[6..])] {
            let mut alone = Fake::new();
            let arm = if of == 0 { handless } else { Fake::arm() };
            let mut single = Loop::new(alone.bind(), &[arm]).expect("sound");
            let mut expected = state(1);
            // SAFETY: as above
            unsafe { single.run(slice::from_mut(&mut expected), own, 2, true) };
            assert_eq!(states[of].goal.pos, expected.goal.pos);
            assert_eq!(states[of].torques, expected.torques);
            assert_eq!(states[of].gripper_action, expected.gripper_action);
        }
        assert_eq!(states[0].gripper_action, [0.0; 2]);
        assert_eq!(states[1].gripper_action, [0.2, -0.2]);
        // SAFETY: as above
        assert_eq!(unsafe { made.run(&mut states, &both[..12], 2, true) }, Status::BadArgument);
        // SAFETY: as above
        assert_eq!(unsafe { made.run(&mut states[..1], &both, 2, true) }, Status::BadArgument);
    }

    #[test]
    fn unsound_bindings_are_refused() {
        let mut fake = Fake::new();
        let (sound, arm) = (fake.bind(), Fake::arm());
        assert!(Loop::new(sound, &[arm]).is_ok());
        assert_eq!(Loop::new(sound, &[]).err(), Some(Status::BadArgument));
        let spoil: [fn(&mut Binding, &mut ArmBinding); 7] = [
            |b, _| b.step2 = None,
            |b, _| b.qm = std::ptr::null(),
            |_, a| a.arm_dof[3] = NV as i32,
            |_, a| a.arm_qpos[0] = -1,
            |_, a| a.gripper_actuator[1] = 9,
            |_, a| a.grip_site = 2,
            |_, a| a.fingers = 1,
        ];
        for (index, spoil) in spoil.iter().enumerate() {
            let (mut binding, mut other) = (sound, arm);
            spoil(&mut binding, &mut other);
            assert_eq!(Loop::new(binding, &[arm, other]).err(), Some(Status::BadArgument), "{index}");
        }
        let handless = ArmBinding { fingers: 0, gripper_actuator: [-1, -1], ..arm };
        assert!(Loop::new(sound, &[handless]).is_ok());
    }

    #[test]
    fn the_c_interface_runs_and_refuses() {
        let mut fake = Fake::new();
        let mut binding = fake.bind();
        let (arm, mut state, null) = (Fake::arm(), state(1), std::ptr::null());
        let action = ACTION.as_ptr();
        // SAFETY: every pointer is valid or null, and the fake outlives the handle
        unsafe {
            let handle = control_open(&binding, &arm, 1);
            assert!(!handle.is_null());
            assert_eq!(control_run(handle, &mut state, action, 2, 1), 0);
            assert_eq!(control_run(handle, &mut state, null, 2, 1), Status::BadArgument as i32);
            assert_eq!(control_run(handle, std::ptr::null_mut(), action, 2, 1), Status::BadArgument as i32);
            assert_eq!(control_run(std::ptr::null_mut(), &mut state, action, 2, 1), Status::BadArgument as i32);
            control_close(handle);
            control_close(std::ptr::null_mut());
            assert!(control_open(&binding, std::ptr::null(), 1).is_null());
            assert!(control_open(&binding, &arm, 0).is_null());
            binding.nsite = 0;
            assert!(control_open(&binding, &arm, 1).is_null());
            assert!(control_open(std::ptr::null(), &arm, 1).is_null());
        }
        assert_eq!(fake.log.len(), 6);
    }
}
