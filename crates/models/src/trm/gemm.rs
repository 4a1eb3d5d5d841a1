//! The matrix product that the fused network uses: `gemm` behind checked views.

use gemm::Parallelism;

/// A view of a matrix in a slice.
#[derive(Clone, Copy)]
pub(super) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Row after row.
    pub(super) fn rows(data: &'a [f32], rows: usize, columns: usize) -> Self {
        Self::strided(data, rows, columns, columns, 1)
    }

    /// With any strides.
    pub(super) fn strided(
        data: &'a [f32],
        rows: usize,
        columns: usize,
        row_stride: usize,
        column_stride: usize,
    ) -> Self {
        let last = rows.saturating_sub(1) * row_stride + columns.saturating_sub(1) * column_stride;
        assert!(rows * columns == 0 || last < data.len(), "a matrix inside its slice");
        Self { data, rows, columns, row_stride, column_stride }
    }

    /// Transposed.
    pub(super) fn t(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }
}

/// `out = a b`, or `out += a b`, with rows of `out` that lie `row_stride` apart.
#[allow(unsafe_code)] // gemm's interface is pointers; the views above are checked against their slices
pub(super) fn multiply(out: &mut [f32], row_stride: usize, a: Matrix<'_>, b: Matrix<'_>, accumulate: bool) {
    let (m, n, k) = (a.rows, b.columns, a.columns);
    assert_eq!(k, b.rows, "inner sizes of a product");
    if m * n == 0 {
        return;
    }
    assert!(n <= row_stride && (m - 1) * row_stride + n <= out.len(), "a product inside its slice");
    // SAFETY: `Matrix` guarantees that every element of `a` and `b` lies inside its slice, the
    // assertion above that every element of `out` does; rows of `out` do not overlap, and `out`
    // is borrowed exclusively. Strides are far below isize::MAX, as they index slices.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            row_stride as isize,
            accumulate,
            a.data.as_ptr(),
            a.column_stride as isize,
            a.row_stride as isize,
            b.data.as_ptr(),
            b.column_stride as isize,
            b.row_stride as isize,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_odd_shapes_and_strides_are_the_naive_sums() {
        let value = |i: usize| ((i * 37 % 101) as f32 - 50.0) / 25.0;
        for (m, n, k) in [(1, 1, 1), (3, 5, 7), (17, 9, 33), (1, 40, 8), (31, 1, 16)] {
            let (ra, rb, ro) = (k + 3, k + 1, n + 2);
            let a: Vec<f32> = (0..m * ra).map(value).collect();
            let b: Vec<f32> = (0..n * rb).map(|i| value(i + 11)).collect();
            let before: Vec<f32> = (0..m * ro).map(|i| value(i + 5)).collect();
            for accumulate in [false, true] {
                let mut out = before.clone();
                let (left, right) = (Matrix::strided(&a, m, k, ra, 1), Matrix::strided(&b, n, k, rb, 1).t());
                multiply(&mut out, ro, left, right, accumulate);
                for (i, j) in (0..m * ro).map(|at| (at / ro, at % ro)) {
                    let old = before[i * ro + j];
                    let dot: f32 = (0..k).map(|l| a[i * ra + l] * b[j.min(n - 1) * rb + l]).sum();
                    let expected = match (j < n, accumulate) {
                        (true, true) => old + dot,
                        (true, false) => dot,
                        (false, _) => old,
                    };
                    assert!((out[i * ro + j] - expected).abs() < 1e-3, "{m}x{n}x{k} at {i}, {j}");
                }
            }
        }
    }
}
