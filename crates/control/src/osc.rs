//! The `OSC_POSE` controller: goals from actions, torques from goals.
//!
//! Formulas and their order follow robosuite 1.5.2, `controllers/parts/arm/osc.py` and
//! `utils/control_utils.py`, for a fixed impedance, delta actions in the base frame, the achieved
//! pose as reference, position and orientation decoupled, seven joints. Dense inverses are taken
//! through Cholesky factors instead of LAPACK, so torques differ from robosuite's by rounding.

use crate::linalg::{Cholesky, pinv_solve};
use crate::rotation::{Mat3, apply, delta_rotation, multiply, orientation_error, transpose};

/// Joints of the arm.
pub const DOF: usize = 7;

/// What a controller's configuration fixes.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Gains {
    /// Stiffness of the three translations and the three rotations.
    pub kp: [f64; 6],
    /// Damping of the same.
    pub kd: [f64; 6],
    /// Actions are clipped to at least this.
    pub input_min: [f64; 6],
    /// Actions are clipped to at most this.
    pub input_max: [f64; 6],
    /// Subtracted from a clipped action.
    pub input_offset: [f64; 6],
    /// Multiplied with what remains; metres and radians per unit of action.
    pub scale: [f64; 6],
    /// Added to the product.
    pub output_offset: [f64; 6],
    /// The joint configuration that the null space is drawn to, radians.
    pub initial_joint: [f64; DOF],
}

/// What the controller knows of the arm, refreshed each substep but the first after a reset.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Arm {
    /// Position of the grip site in the world, metres.
    pub ref_pos: [f64; 3],
    /// Orientation of the grip site in the world.
    pub ref_ori: Mat3,
    /// Velocity of the grip site.
    pub ref_pos_vel: [f64; 3],
    /// Angular velocity of the grip site.
    pub ref_ori_vel: [f64; 3],
    /// Joint angles.
    pub joint_pos: [f64; DOF],
    /// Joint velocities.
    pub joint_vel: [f64; DOF],
    /// The arm's block of the joint-space inertia matrix.
    pub mass: [[f64; DOF]; DOF],
    /// Translational over rotational Jacobian of the grip site, the arm's columns.
    pub jacobian: [[f64; DOF]; 6],
}

/// A pose: where the controller's base stands in the world, or the goal as seen from there.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct Pose {
    /// Position, metres.
    pub pos: [f64; 3],
    /// Orientation.
    pub ori: Mat3,
}

/// `numpy.clip` of one number: a NaN stays a NaN.
pub fn clip(value: f64, low: f64, high: f64) -> f64 {
    if value < low {
        low
    } else if value > high {
        high
    } else {
        value
    }
}

/// The goal that an action asks for, in the frame of `origin`.
pub fn goal(gains: &Gains, action: &[f64; 6], arm: &Arm, origin: &Pose) -> Pose {
    let scaled: [f64; 6] = std::array::from_fn(|i| {
        let clipped = clip(action[i], gains.input_min[i], gains.input_max[i]);
        (clipped - gains.input_offset[i]) * gains.scale[i] + gains.output_offset[i]
    });
    // robosuite multiplies homogeneous matrices: R^T p + (-R^T o), not R^T (p - o)
    let inverse = transpose(&origin.ori);
    let shift = apply(&inverse, &origin.pos);
    let seen = apply(&inverse, &arm.ref_pos);
    let pos = [0, 1, 2].map(|i| (seen[i] - shift[i]) + scaled[i]);
    let turn = delta_rotation([scaled[3], scaled[4], scaled[5]]);
    let ori = multiply(&turn, &multiply(&inverse, &arm.ref_ori));
    Pose { pos, ori }
}

/// Joint torques that drive the arm to `goal`, before clipping; `bias` is the arm's part of
/// `qfrc_bias`. `None` where the inertia matrix is no inertia matrix: the simulation has diverged.
pub fn torques(gains: &Gains, arm: &Arm, origin: &Pose, goal: &Pose, bias: &[f64; DOF]) -> Option<[f64; DOF]> {
    let turned = apply(&origin.ori, &goal.pos);
    let desired_ori = multiply(&origin.ori, &goal.ori);
    let ori_error = orientation_error(&desired_ori, &arm.ref_ori);
    let force = [0, 1, 2].map(|i| {
        let error = (origin.pos[i] + turned[i]) - arm.ref_pos[i];
        error * gains.kp[i] - arm.ref_pos_vel[i] * gains.kd[i]
    });
    let torque = [0, 1, 2].map(|i| ori_error[i] * gains.kp[3 + i] - arm.ref_ori_vel[i] * gains.kd[3 + i]);

    // J M^-1 J^T as W^T W with W = G^-1 J^T, where M = G G^T
    let factor = Cholesky::new(&arm.mass)?;
    let w: [[f64; DOF]; 6] = std::array::from_fn(|i| factor.forward(&arm.jacobian[i]));
    let mut inertia_inv = [[0.0; 6]; 6];
    for i in 0..6 {
        for j in 0..=i {
            let mut sum = 0.0;
            for k in 0..DOF {
                sum += w[i][k] * w[j][k];
            }
            inertia_inv[i][j] = sum;
            inertia_inv[j][i] = sum;
        }
    }
    let block = |o: usize| -> [[f64; 3]; 3] { [0, 1, 2].map(|i| [0, 1, 2].map(|j| inertia_inv[o + i][o + j])) };
    let f = pinv_solve(&block(0), &force);
    let t = pinv_solve(&block(3), &torque);
    let wrench = [f[0], f[1], f[2], t[0], t[1], t[2]];

    // N^T M a with N = I - M^-1 J^T L J is M a - J^T L J a
    const JOINT_KP: f64 = 10.0;
    let joint_kv = JOINT_KP.sqrt() * 2.0;
    let rest: [f64; DOF] =
        std::array::from_fn(|i| JOINT_KP * (gains.initial_joint[i] - arm.joint_pos[i]) - joint_kv * arm.joint_vel[i]);
    let mut pull = [0.0; 6];
    for i in 0..6 {
        for k in 0..DOF {
            pull[i] += arm.jacobian[i][k] * rest[k];
        }
    }
    let held = pinv_solve(&inertia_inv, &pull);

    let mut tau = [0.0; DOF];
    for (j, tau) in tau.iter_mut().enumerate() {
        let (mut task, mut posture, mut overlap) = (0.0, 0.0, 0.0);
        for i in 0..6 {
            task += arm.jacobian[i][j] * wrench[i];
            overlap += arm.jacobian[i][j] * held[i];
        }
        for k in 0..DOF {
            posture += arm.mass[j][k] * rest[k];
        }
        *tau = (task + bias[j]) + (posture - overlap);
    }
    Some(tau)
}

#[cfg(test)]
mod tests {
    use super::*;

    type Matrix = Vec<Vec<f64>>;

    fn zeros(rows: usize, columns: usize) -> Matrix {
        vec![vec![0.0; columns]; rows]
    }

    fn dot(a: &Matrix, b: &Matrix) -> Matrix {
        let mut out = zeros(a.len(), b[0].len());
        for i in 0..a.len() {
            for j in 0..b[0].len() {
                out[i][j] = (0..b.len()).map(|k| a[i][k] * b[k][j]).sum();
            }
        }
        out
    }

    fn t(a: &Matrix) -> Matrix {
        (0..a[0].len()).map(|j| a.iter().map(|row| row[j]).collect()).collect()
    }

    /// Gauss-Jordan with full row pivoting.
    fn inverse(a: &Matrix) -> Matrix {
        let n = a.len();
        let mut m: Matrix = (0..n)
            .map(|i| {
                let mut row = a[i].clone();
                row.extend((0..n).map(|j| f64::from(u8::from(i == j))));
                row
            })
            .collect();
        for c in 0..n {
            let p = (c..n).max_by(|&x, &y| m[x][c].abs().total_cmp(&m[y][c].abs())).expect("rows");
            m.swap(c, p);
            let pivot = m[c][c];
            m[c].iter_mut().for_each(|x| *x /= pivot);
            for r in 0..n {
                if r != c {
                    let factor = m[r][c];
                    for k in 0..2 * n {
                        m[r][k] -= factor * m[c][k];
                    }
                }
            }
        }
        m.into_iter().map(|row| row[n..].to_vec()).collect()
    }

    /// The controller as its Python source spells it, with explicit inverses and null space matrix.
    fn literal(gains: &Gains, arm: &Arm, origin: &Pose, goal: &Pose, bias: &[f64; DOF]) -> Vec<f64> {
        let column = |v: &[f64]| -> Matrix { v.iter().map(|&x| vec![x]).collect() };
        let m: Matrix = arm.mass.iter().map(|r| r.to_vec()).collect();
        let j: Matrix = arm.jacobian.iter().map(|r| r.to_vec()).collect();
        let m_inv = inverse(&m);
        let lambda = |j: &Matrix| inverse(&dot(&dot(j, &m_inv), &t(j)));
        let full = lambda(&j);
        let pos = lambda(&j[..3].to_vec());
        let ori = lambda(&j[3..].to_vec());
        let turned = apply(&origin.ori, &goal.pos);
        let error = orientation_error(&multiply(&origin.ori, &goal.ori), &arm.ref_ori);
        let force: Vec<f64> = (0..3)
            .map(|i| (origin.pos[i] + turned[i] - arm.ref_pos[i]) * gains.kp[i] + -arm.ref_pos_vel[i] * gains.kd[i])
            .collect();
        let torque: Vec<f64> =
            (0..3).map(|i| error[i] * gains.kp[3 + i] + -arm.ref_ori_vel[i] * gains.kd[3 + i]).collect();
        let mut wrench = dot(&pos, &column(&force));
        wrench.extend(dot(&ori, &column(&torque)));
        let jbar = dot(&dot(&m_inv, &t(&j)), &full);
        let jj = dot(&jbar, &j);
        let mut null = zeros(7, 7);
        for r in 0..7 {
            for c in 0..7 {
                null[r][c] = f64::from(u8::from(r == c)) - jj[r][c];
            }
        }
        let rest: Vec<f64> = (0..7)
            .map(|i| 10.0 * (gains.initial_joint[i] - arm.joint_pos[i]) - 2.0 * 10.0_f64.sqrt() * arm.joint_vel[i])
            .collect();
        let posture = dot(&t(&null), &dot(&m, &column(&rest)));
        let task = dot(&t(&j), &wrench);
        (0..7).map(|i| task[i][0] + bias[i] + posture[i][0]).collect()
    }

    fn sample(seed: u64) -> (Gains, Arm, Pose, Pose, [f64; DOF]) {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
        };
        let gains = Gains {
            kp: [150.0; 6],
            kd: [2.0 * 150.0_f64.sqrt(); 6],
            input_min: [-1.0; 6],
            input_max: [1.0; 6],
            input_offset: [0.0; 6],
            scale: [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
            output_offset: [0.0; 6],
            initial_joint: std::array::from_fn(|_| next()),
        };
        let factor: [[f64; DOF]; DOF] = std::array::from_fn(|_| std::array::from_fn(|_| next()));
        let mut mass = [[0.0; DOF]; DOF];
        for i in 0..DOF {
            for j in 0..DOF {
                mass[i][j] = (0..DOF).map(|k| factor[i][k] * factor[j][k]).sum::<f64>();
            }
            mass[i][i] += 0.5;
        }
        let arm = Arm {
            ref_pos: std::array::from_fn(|_| next()),
            ref_ori: delta_rotation(std::array::from_fn(|_| next())),
            ref_pos_vel: std::array::from_fn(|_| 0.1 * next()),
            ref_ori_vel: std::array::from_fn(|_| 0.1 * next()),
            joint_pos: std::array::from_fn(|_| next()),
            joint_vel: std::array::from_fn(|_| 0.1 * next()),
            mass,
            jacobian: std::array::from_fn(|_| std::array::from_fn(|_| next())),
        };
        let origin =
            Pose { pos: std::array::from_fn(|_| next()), ori: delta_rotation(std::array::from_fn(|_| next())) };
        let action = std::array::from_fn(|_| 1.5 * next());
        let goal = goal(&gains, &action, &arm, &origin);
        (gains, arm, origin, goal, std::array::from_fn(|_| 5.0 * next()))
    }

    #[test]
    fn torques_are_those_of_the_literal_formulas() {
        let mut compared = 0;
        for seed in 1..=300 {
            let (gains, arm, origin, goal, bias) = sample(seed);
            let ours = torques(&gains, &arm, &origin, &goal, &bias).expect("regular");
            let naive = literal(&gains, &arm, &origin, &goal, &bias);
            let size = naive.iter().fold(1.0_f64, |m, x| m.max(x.abs()));
            for i in 0..DOF {
                // random Jacobians are worse conditioned than an arm's: relative to the largest
                assert!((ours[i] - naive[i]).abs() < 1e-8 * size, "seed {seed}: {ours:?} {naive:?}");
                compared += 1;
            }
        }
        assert_eq!(compared, 300 * DOF);
    }

    #[test]
    fn a_null_action_asks_for_the_achieved_pose() {
        let (gains, arm, origin, _, _) = sample(5);
        let rest = goal(&gains, &[0.0; 6], &arm, &origin);
        let seen = apply(&origin.ori, &rest.pos);
        for i in 0..3 {
            // origin.ori is a rotation to single precision only
            assert!((origin.pos[i] + seen[i] - arm.ref_pos[i]).abs() < 1e-6);
        }
    }

    #[test]
    fn actions_are_clipped_before_they_are_scaled() {
        let (gains, arm, origin, _, _) = sample(9);
        let wild = goal(&gains, &[7.0, -7.0, 1.0, 0.0, 0.0, 3.0], &arm, &origin);
        let tame = goal(&gains, &[1.0, -1.0, 1.0, 0.0, 0.0, 1.0], &arm, &origin);
        assert_eq!(wild.pos, tame.pos);
        assert_eq!(wild.ori, tame.ori);
        assert!(clip(f64::NAN, -1.0, 1.0).is_nan());
    }

    #[test]
    fn a_diverged_inertia_matrix_has_no_torques() {
        let (gains, mut arm, origin, goal, bias) = sample(2);
        arm.mass[3][3] = f64::NAN;
        assert!(torques(&gains, &arm, &origin, &goal, &bias).is_none());
    }
}
