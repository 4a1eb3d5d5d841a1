//! Rotations as axis-angle and as 6D, with exact inverses.
//!
//! 6D is the first two rows of the rotation matrix (Zhou et al., "On the continuity of rotation
//! representations in neural networks", CVPR 2019), laid out as pytorch3d and robomimic do. Axis-angle is the
//! unit axis times the angle in radians; the inverse returns the angle in `[0, pi]`.

/// Numbers of one arm's action with the rotation as axis-angle: position, axis-angle, gripper.
const AXIS_ANGLE_WIDTH: usize = 7;
/// Numbers of one arm's action with the rotation as 6D: position, 6D, gripper.
const SIX_D_WIDTH: usize = 10;

/// The rotation matrix (rows) of an axis-angle vector, by Rodrigues' formula.
pub fn matrix_from_axis_angle(v: [f64; 3]) -> [[f64; 3]; 3] {
    let angle = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    // sin(a)/a and (1-cos(a))/a^2, by their series where the quotient would lose digits
    let (s, c) = if angle < 1e-4 {
        let a2 = angle * angle;
        (1.0 - a2 / 6.0, 0.5 - a2 / 24.0)
    } else {
        let half = (angle / 2.0).sin();
        (angle.sin() / angle, 2.0 * half * half / (angle * angle))
    };
    let [x, y, z] = v;
    [
        [1.0 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
        [c * x * y + s * z, 1.0 - c * (x * x + z * z), c * y * z - s * x],
        [c * x * z - s * y, c * y * z + s * x, 1.0 - c * (x * x + y * y)],
    ]
}

/// The axis-angle vector of a rotation matrix (rows); the angle is in `[0, pi]`.
///
/// Goes by way of the quaternion with the largest component (Shepperd's method), which keeps full precision
/// at both ends of the range.
pub fn axis_angle_from_matrix(m: [[f64; 3]; 3]) -> [f64; 3] {
    let trace = m[0][0] + m[1][1] + m[2][2];
    let squares = [trace, m[0][0], m[1][1], m[2][2]];
    let mut largest = 0;
    for (i, s) in squares.iter().enumerate() {
        if *s > squares[largest] {
            largest = i;
        }
    }
    // unnormalised quaternion (w, x, y, z)
    let q = match largest {
        0 => [1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]],
        1 => [m[2][1] - m[1][2], 1.0 + 2.0 * m[0][0] - trace, m[0][1] + m[1][0], m[0][2] + m[2][0]],
        2 => [m[0][2] - m[2][0], m[0][1] + m[1][0], 1.0 + 2.0 * m[1][1] - trace, m[1][2] + m[2][1]],
        _ => [m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1.0 + 2.0 * m[2][2] - trace],
    };
    let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
    let (w, x, y, z) = (sign * q[0], sign * q[1], sign * q[2], sign * q[3]);
    let sine = (x * x + y * y + z * z).sqrt();
    if sine == 0.0 {
        return [0.0; 3];
    }
    let scale = 2.0 * sine.atan2(w) / sine;
    [x * scale, y * scale, z * scale]
}

/// 6D from axis-angle.
pub fn six_d_from_axis_angle(v: [f64; 3]) -> [f64; 6] {
    let [a, b, _] = matrix_from_axis_angle(v);
    [a[0], a[1], a[2], b[0], b[1], b[2]]
}

/// Axis-angle from 6D. The two rows are made orthonormal first (Gram-Schmidt), as a policy's output is not.
/// `None` when they do not span a plane.
pub fn axis_angle_from_six_d(d: [f64; 6]) -> Option<[f64; 3]> {
    let first = unit([d[0], d[1], d[2]])?;
    let second = [d[3], d[4], d[5]];
    let along: f64 = first.iter().zip(second).map(|(a, b)| a * b).sum();
    let second = unit([second[0] - along * first[0], second[1] - along * first[1], second[2] - along * first[2]])?;
    let third = [
        first[1] * second[2] - first[2] * second[1],
        first[2] * second[0] - first[0] * second[2],
        first[0] * second[1] - first[1] * second[0],
    ];
    Some(axis_angle_from_matrix([first, second, third]))
}

fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    (norm > 1e-12 && norm.is_finite()).then(|| v.map(|x| x / norm))
}

/// Actions of any number of arms with 6D rotations, from rows of (position 3, axis-angle 3, gripper 1) an arm.
///
/// # Panics
/// When the length is no multiple of 7.
pub fn actions_to_6d(actions: &[f32]) -> Vec<f32> {
    assert_eq!(actions.len() % AXIS_ANGLE_WIDTH, 0, "7 numbers an arm");
    let mut out = Vec::with_capacity(actions.len() / AXIS_ANGLE_WIDTH * SIX_D_WIDTH);
    for arm in actions.chunks_exact(AXIS_ANGLE_WIDTH) {
        out.extend_from_slice(&arm[..3]);
        let rotation = six_d_from_axis_angle([arm[3].into(), arm[4].into(), arm[5].into()]);
        out.extend(rotation.map(|v| v as f32));
        out.push(arm[6]);
    }
    out
}

/// The inverse of [`actions_to_6d`], for rollouts. `None` when a rotation is degenerate or the length is no
/// multiple of 10.
pub fn actions_from_6d(actions: &[f32]) -> Option<Vec<f32>> {
    if !actions.len().is_multiple_of(SIX_D_WIDTH) {
        return None;
    }
    let mut out = Vec::with_capacity(actions.len() / SIX_D_WIDTH * AXIS_ANGLE_WIDTH);
    for arm in actions.chunks_exact(SIX_D_WIDTH) {
        out.extend_from_slice(&arm[..3]);
        let mut six = [0.0; 6];
        for (to, from) in six.iter_mut().zip(&arm[3..9]) {
            *to = f64::from(*from);
        }
        out.extend(axis_angle_from_six_d(six)?.map(|v| v as f32));
        out.push(arm[9]);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn difference(a: [f64; 3], b: [f64; 3]) -> f64 {
        a.iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max)
    }

    proptest! {
        #[test]
        fn six_d_and_back_is_the_same_rotation(x in -1.0_f64..1.0, y in -1.0_f64..1.0, z in -1.0_f64..1.0, angle in 0.0_f64..3.1) {
            let norm = (x * x + y * y + z * z).sqrt();
            prop_assume!(norm > 1e-3);
            let v = [x / norm * angle, y / norm * angle, z / norm * angle];
            let back = axis_angle_from_six_d(six_d_from_axis_angle(v)).unwrap();
            prop_assert!(difference(v, back) < 1e-11, "{v:?} {back:?}");
        }

        #[test]
        fn small_rotations_keep_their_digits(x in -1.0_f64..1.0, y in -1.0_f64..1.0, z in -1.0_f64..1.0, e in -9_i32..0) {
            let v = [x, y, z].map(|c| c * 10.0_f64.powi(e));
            let back = axis_angle_from_six_d(six_d_from_axis_angle(v)).unwrap();
            prop_assert!(difference(v, back) < 1e-12, "{v:?} {back:?}");
        }

        #[test]
        fn half_turns_come_back_up_to_sign(x in -1.0_f64..1.0, y in -1.0_f64..1.0, z in -1.0_f64..1.0) {
            let norm = (x * x + y * y + z * z).sqrt();
            prop_assume!(norm > 1e-3);
            let v = [x, y, z].map(|c| c / norm * std::f64::consts::PI);
            let back = axis_angle_from_six_d(six_d_from_axis_angle(v)).unwrap();
            prop_assert!(difference(v, back).min(difference(v.map(|c| -c), back)) < 1e-6);
        }
    }

    #[test]
    fn a_quarter_turn_about_z_has_the_rows_of_its_matrix() {
        let six = six_d_from_axis_angle([0.0, 0.0, std::f64::consts::FRAC_PI_2]);
        for (got, expected) in six.iter().zip([0.0, -1.0, 0.0, 1.0, 0.0, 0.0]) {
            assert!((got - expected).abs() < 1e-15);
        }
    }

    #[test]
    fn actions_go_to_6d_and_back_arm_by_arm() {
        let actions = [0.1, 0.2, 0.3, 0.4, -0.5, 0.6, 1.0, -0.1, -0.2, -0.3, 0.0, 0.0, 0.0, -1.0];
        let six = actions_to_6d(&actions);
        assert_eq!(six.len(), 20);
        let back = actions_from_6d(&six).unwrap();
        for (a, b) in actions.iter().zip(back) {
            assert!((a - b).abs() < 1e-6);
        }
        assert_eq!(actions_from_6d(&[0.0; 10]), None);
        assert_eq!(actions_from_6d(&six[..9]), None);
    }
}
