//! Rotations from axis-angle to 6D.
//!
//! 6D is the first two rows of the rotation matrix (Zhou et al., "On the continuity of rotation
//! representations in neural networks", CVPR 2019), laid out as pytorch3d and robomimic do. Axis-angle is the
//! unit axis times the angle in radians.

/// Numbers of one arm's action with the rotation as axis-angle: position, axis-angle, gripper.
const AXIS_ANGLE_WIDTH: usize = 7;
/// Numbers of one arm's action with the rotation as 6D: position, 6D, gripper.
const SIX_D_WIDTH: usize = 10;

/// The rotation matrix (rows) of an axis-angle vector, by Rodrigues' formula.
fn matrix_from_axis_angle(v: [f64; 3]) -> [[f64; 3]; 3] {
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

/// 6D from axis-angle.
fn six_d_from_axis_angle(v: [f64; 3]) -> [f64; 6] {
    let [a, b, _] = matrix_from_axis_angle(v);
    [a[0], a[1], a[2], b[0], b[1], b[2]]
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_turn_about_z_has_the_rows_of_its_matrix() {
        let six = six_d_from_axis_angle([0.0, 0.0, std::f64::consts::FRAC_PI_2]);
        for (got, expected) in six.iter().zip([0.0, -1.0, 0.0, 1.0, 0.0, 0.0]) {
            assert!((got - expected).abs() < 1e-15);
        }
    }

    #[test]
    fn actions_go_to_6d_arm_by_arm() {
        let actions = [0.1, 0.2, 0.3, 0.4, -0.5, 0.6, 1.0, -0.1, -0.2, -0.3, 0.0, 0.0, 0.0, -1.0];
        let six = actions_to_6d(&actions);
        assert_eq!(six.len(), 20);
        assert_eq!(six[10..], [-0.1, -0.2, -0.3, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0]);
    }
}
