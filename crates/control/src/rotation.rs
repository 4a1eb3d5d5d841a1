//! Rotations as robosuite's `transform_utils` and `control_utils` compute them.

/// A 3x3 matrix, row-major.
pub type Mat3 = [[f64; 3]; 3];

/// Four times the double-precision epsilon: `transform_utils.EPS`.
const EPS: f64 = f64::EPSILON * 4.0;

/// The rotation matrix of a scaled axis: `quat2mat(axisangle2quat(vec))`.
///
/// robosuite's `quat2mat` rounds the quaternion to single precision and multiplies there, so the
/// result is a rotation only to about 1e-7. Its control depends on that, hence it is reproduced
/// operation by operation: the quaternion in doubles, the products in singles, `1 - a - b` in
/// doubles again.
pub fn delta_rotation(vec: [f64; 3]) -> Mat3 {
    let angle = (vec[0] * vec[0] + vec[1] * vec[1] + vec[2] * vec[2]).sqrt();
    // math.isclose(angle, 0.0) without an absolute tolerance holds for zero only
    let [x, y, z, w] = if angle == 0.0 {
        [0.0, 0.0, 0.0, 1.0]
    } else {
        let (sin, cos) = ((angle / 2.0).sin(), (angle / 2.0).cos());
        [vec[0] / angle * sin, vec[1] / angle * sin, vec[2] / angle * sin, cos]
    };
    quaternion_matrix([w as f32, x as f32, y as f32, z as f32])
}

/// The matrix of a single-precision quaternion (w, x, y, z), in robosuite's mixture of precisions.
fn quaternion_matrix(q: [f32; 4]) -> Mat3 {
    // OpenBLAS' sdot, which numba calls: single products, summed in doubles, rounded once
    let n = q.iter().map(|c| f64::from(c * c)).sum::<f64>() as f32;
    if f64::from(n) < EPS {
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    }
    let scale = (2.0 / f64::from(n)).sqrt();
    let q = q.map(|c| (f64::from(c) * scale) as f32);
    let p = |i: usize, j: usize| q[i] * q[j];
    let diagonal = |i: usize, j: usize| 1.0 - f64::from(p(i, i)) - f64::from(p(j, j));
    [
        [diagonal(2, 3), f64::from(p(1, 2) - p(3, 0)), f64::from(p(1, 3) + p(2, 0))],
        [f64::from(p(1, 2) + p(3, 0)), diagonal(1, 3), f64::from(p(2, 3) - p(1, 0))],
        [f64::from(p(1, 3) - p(2, 0)), f64::from(p(2, 3) + p(1, 0)), diagonal(1, 2)],
    ]
}

/// Half the sum of the cross products of the columns of `current` and `desired`:
/// `control_utils.orientation_error`, in radians for small angles.
pub fn orientation_error(desired: &Mat3, current: &Mat3) -> [f64; 3] {
    let column = |m: &Mat3, c: usize| [m[0][c], m[1][c], m[2][c]];
    let cross =
        |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let [a, b, c] = [0, 1, 2].map(|k| cross(column(current, k), column(desired, k)));
    [0, 1, 2].map(|i| 0.5 * (a[i] + b[i] + c[i]))
}

/// `a b`.
pub fn multiply(a: &Mat3, b: &Mat3) -> Mat3 {
    let mut out = [[0.0; 3]; 3];
    for (i, row) in out.iter_mut().enumerate() {
        for (j, value) in row.iter_mut().enumerate() {
            *value = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
        }
    }
    out
}

/// `a v`.
pub fn apply(a: &Mat3, v: &[f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| a[i][0] * v[0] + a[i][1] * v[1] + a[i][2] * v[2])
}

/// The transpose of `a`.
pub fn transpose(a: &Mat3) -> Mat3 {
    [0, 1, 2].map(|i| [a[0][i], a[1][i], a[2][i]])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rodrigues' formula in doubles: what `delta_rotation` would be without single precision.
    fn rodrigues(v: [f64; 3]) -> Mat3 {
        let angle = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
        if angle == 0.0 {
            return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        }
        let [x, y, z] = v.map(|c| c / angle);
        let (s, c) = angle.sin_cos();
        let t = 1.0 - c;
        [
            [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
            [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
            [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
        ]
    }

    fn worst(a: &Mat3, b: &Mat3) -> f64 {
        let mut worst: f64 = 0.0;
        for i in 0..3 {
            for j in 0..3 {
                worst = worst.max((a[i][j] - b[i][j]).abs());
            }
        }
        worst
    }

    #[test]
    fn a_zero_vector_is_not_quite_the_identity() {
        // 1 * sqrt(2) rounds to a single whose square is not 2: no effect with zeros around it
        let m = delta_rotation([0.0; 3]);
        assert_eq!(m, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
    }

    #[test]
    fn delta_rotation_is_rodrigues_to_single_precision_and_no_better() {
        let mut largest: f64 = 0.0;
        for i in 0..200 {
            let t = f64::from(i) * 0.37;
            let v = [0.5 * t.sin(), 0.5 * (1.7 * t).cos(), 0.5 * (0.3 * t).sin()];
            let error = worst(&delta_rotation(v), &rodrigues(v));
            assert!(error < 3e-7, "{v:?}: {error}");
            largest = largest.max(error);
        }
        // a port in doubles would agree to 1e-15: the quirk must be there
        assert!(largest > 1e-9, "{largest}");
    }

    #[test]
    fn orientation_error_of_a_small_turn_is_its_scaled_axis() {
        let current = rodrigues([0.3, -0.8, 1.1]);
        let turn = [1e-4, -2e-4, 5e-5];
        let desired = multiply(&rodrigues(turn), &current);
        let error = orientation_error(&desired, &current);
        for i in 0..3 {
            assert!((error[i] - turn[i]).abs() < 1e-10, "{error:?}");
        }
        assert_eq!(orientation_error(&current, &current), [0.0; 3]);
    }
}
