//! Small dense algebra on fixed sizes: Cholesky factors for the usual case, an eigenvalue
//! pseudo-inverse for the singular one.

/// `numpy.linalg.pinv`'s default: singular values below this share of the largest count as zero.
const PINV_RCOND: f64 = 1e-15;

/// Below this ratio of the smallest to the largest pivot a matrix may lose a singular value to
/// [`PINV_RCOND`], so it goes through [`pseudo_inverse`].
const PIVOT_RATIO: f64 = 1e-12;

/// The lower Cholesky factor of a symmetric positive definite matrix.
pub struct Cholesky<const N: usize> {
    /// The factor; entries above the diagonal are zero.
    lower: [[f64; N]; N],
    /// One over the diagonal of the factor.
    inverse_diagonal: [f64; N],
}

impl<const N: usize> Cholesky<N> {
    /// Factors the lower triangle of `a`; `None` if it is not safely positive definite.
    pub fn new(a: &[[f64; N]; N]) -> Option<Self> {
        let mut lower = [[0.0; N]; N];
        let mut inverse_diagonal = [0.0; N];
        let (mut smallest, mut largest) = (f64::INFINITY, 0.0_f64);
        for j in 0..N {
            let mut pivot = a[j][j];
            for k in 0..j {
                pivot -= lower[j][k] * lower[j][k];
            }
            smallest = smallest.min(pivot);
            largest = largest.max(a[j][j]);
            // written so that a NaN is refused as well
            if !(pivot > 0.0 && pivot.is_finite() && smallest > PIVOT_RATIO * largest) {
                return None;
            }
            let root = pivot.sqrt();
            lower[j][j] = root;
            inverse_diagonal[j] = 1.0 / root;
            for i in j + 1..N {
                let mut sum = a[i][j];
                for k in 0..j {
                    sum -= lower[i][k] * lower[j][k];
                }
                lower[i][j] = sum * inverse_diagonal[j];
            }
        }
        Some(Self { lower, inverse_diagonal })
    }

    /// `L^-1 b`.
    pub fn forward(&self, b: &[f64; N]) -> [f64; N] {
        let mut x = *b;
        for i in 0..N {
            for k in 0..i {
                x[i] -= self.lower[i][k] * x[k];
            }
            x[i] *= self.inverse_diagonal[i];
        }
        x
    }

    /// `A^-1 b`.
    pub fn solve(&self, b: &[f64; N]) -> [f64; N] {
        let mut x = self.forward(b);
        for i in (0..N).rev() {
            for k in i + 1..N {
                x[i] -= self.lower[k][i] * x[k];
            }
            x[i] *= self.inverse_diagonal[i];
        }
        x
    }
}

/// `pinv(a) b` for a symmetric positive semi-definite `a`.
pub fn pinv_solve<const N: usize>(a: &[[f64; N]; N], b: &[f64; N]) -> [f64; N] {
    match Cholesky::new(a) {
        Some(factor) => factor.solve(b),
        None => {
            let inverse = pseudo_inverse(a);
            let mut x = [0.0; N];
            for i in 0..N {
                for k in 0..N {
                    x[i] += inverse[i][k] * b[k];
                }
            }
            x
        }
    }
}

/// The Moore-Penrose inverse of a symmetric matrix, by Jacobi rotations; singular values of at
/// most 1e-15 of the largest count as zero, as in `numpy.linalg.pinv`.
pub fn pseudo_inverse<const N: usize>(a: &[[f64; N]; N]) -> [[f64; N]; N] {
    let mut a = *a;
    let mut vectors = [[0.0; N]; N];
    for (i, row) in vectors.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    for _sweep in 0..60 {
        let (mut off, mut on) = (0.0, 0.0);
        for i in 0..N {
            on += a[i][i] * a[i][i];
            for j in 0..i {
                off += a[i][j] * a[i][j];
            }
        }
        // a NaN ends the sweeps and spreads into the result
        if off <= 1e-36 * on || off.is_nan() {
            break;
        }
        for p in 0..N {
            for q in p + 1..N {
                if a[q][p] == 0.0 {
                    continue;
                }
                let theta = (a[q][q] - a[p][p]) / (2.0 * a[q][p]);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                for k in 0..N {
                    let (x, y) = (a[k][p], a[k][q]);
                    a[k][p] = c * x - s * y;
                    a[k][q] = s * x + c * y;
                }
                for k in 0..N {
                    let (x, y) = (a[p][k], a[q][k]);
                    a[p][k] = c * x - s * y;
                    a[q][k] = s * x + c * y;
                }
                for row in &mut vectors {
                    let (x, y) = (row[p], row[q]);
                    row[p] = c * x - s * y;
                    row[q] = s * x + c * y;
                }
            }
        }
    }
    let largest = (0..N).fold(0.0_f64, |m, i| m.max(a[i][i].abs()));
    let mut out = [[0.0; N]; N];
    for k in 0..N {
        let value = a[k][k];
        if value.abs() <= PINV_RCOND * largest {
            continue;
        }
        for i in 0..N {
            for j in 0..N {
                out[i][j] += vectors[i][k] * vectors[j][k] / value;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small generator for test matrices (64-bit LCG, upper bits).
    pub struct Lcg(pub u64);
    impl Lcg {
        pub fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
        }
    }

    fn gram<const N: usize, const K: usize>(rng: &mut Lcg) -> [[f64; N]; N] {
        let mut b = [[0.0; K]; N];
        b.iter_mut().flatten().for_each(|x| *x = rng.next());
        let mut a = [[0.0; N]; N];
        for i in 0..N {
            for j in 0..N {
                a[i][j] = (0..K).map(|k| b[i][k] * b[j][k]).sum();
            }
        }
        a
    }

    fn product<const N: usize>(a: &[[f64; N]; N], b: &[[f64; N]; N]) -> [[f64; N]; N] {
        let mut out = [[0.0; N]; N];
        for i in 0..N {
            for j in 0..N {
                out[i][j] = (0..N).map(|k| a[i][k] * b[k][j]).sum();
            }
        }
        out
    }

    fn worst<const N: usize>(a: &[[f64; N]; N], b: &[[f64; N]; N]) -> f64 {
        a.iter().flatten().zip(b.iter().flatten()).fold(0.0, |m, (x, y)| m.max((x - y).abs()))
    }

    #[test]
    fn cholesky_solves_what_it_factored() {
        let mut rng = Lcg(7);
        for _ in 0..200 {
            let a = gram::<6, 9>(&mut rng);
            let x: [f64; 6] = std::array::from_fn(|_| rng.next());
            let b: [f64; 6] = std::array::from_fn(|i| (0..6).map(|k| a[i][k] * x[k]).sum());
            let solved = Cholesky::new(&a).expect("a Gram matrix of full rank").solve(&b);
            for i in 0..6 {
                // the worst of these matrices has a condition number of about 1e4
                assert!((solved[i] - x[i]).abs() < 1e-10, "{solved:?} {x:?}");
            }
        }
    }

    #[test]
    fn pseudo_inverse_of_a_deficient_matrix_inverts_its_regular_part() {
        let mut rng = Lcg(11);
        for _ in 0..50 {
            let block = gram::<4, 6>(&mut rng);
            // the regular part sits on these rows and columns, zeros elsewhere: rank 4 of 6
            let places = [5, 0, 2, 3];
            let mut a = [[0.0; 6]; 6];
            for i in 0..4 {
                for j in 0..4 {
                    a[places[i]][places[j]] = block[i][j];
                }
            }
            assert!(Cholesky::new(&a).is_none());
            let p = pseudo_inverse(&a);
            let mut part = [[0.0; 4]; 4];
            for i in 0..4 {
                for j in 0..4 {
                    part[i][j] = p[places[i]][places[j]];
                }
            }
            let mut identity = [[0.0; 4]; 4];
            (0..4).for_each(|i| identity[i][i] = 1.0);
            assert!(worst(&product(&part, &block), &identity) < 1e-10);
            for k in [1, 4] {
                assert!((0..6).all(|i| p[i][k] == 0.0 && p[k][i] == 0.0));
            }
        }
    }

    #[test]
    fn pseudo_inverse_of_a_diagonal_drops_what_rcond_drops() {
        let mut a = [[0.0; 3]; 3];
        (a[0][0], a[1][1], a[2][2]) = (4.0, 4e-14, 3.9e-15);
        let p = pseudo_inverse(&a);
        assert_eq!(p[0][0], 0.25);
        assert_eq!(p[1][1], 1.0 / 4e-14);
        assert_eq!(p[2][2], 0.0);
    }

    #[test]
    fn both_ways_agree_on_a_regular_matrix() {
        let mut rng = Lcg(3);
        for _ in 0..100 {
            let a = gram::<3, 7>(&mut rng);
            let b: [f64; 3] = std::array::from_fn(|_| rng.next());
            let solved = pinv_solve(&a, &b);
            let p = pseudo_inverse(&a);
            for i in 0..3 {
                let expected: f64 = (0..3).map(|k| p[i][k] * b[k]).sum();
                assert!((solved[i] - expected).abs() < 1e-11 * (1.0 + expected.abs()));
            }
        }
    }

    #[test]
    fn not_a_number_is_not_factored() {
        let mut a = [[0.0; 3]; 3];
        (a[0][0], a[1][1], a[2][2]) = (1.0, f64::NAN, 1.0);
        assert!(Cholesky::new(&a).is_none());
        assert!(pinv_solve(&a, &[1.0; 3]).iter().any(|x| x.is_nan()));
    }
}
