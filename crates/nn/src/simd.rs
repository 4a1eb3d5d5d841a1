//! Plain loops compiled for the widest vectors of the machine that runs them.

use pulp::{Scalar, Simd, WithSimd};

struct Run<F>(F);

impl<F: FnOnce() -> R, R> WithSimd for Run<F> {
    type Output = R;
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> R {
        (self.0)()
    }
}

/// Runs `op` with the widest instruction set found at run time.
#[inline]
pub fn dispatch<Op: WithSimd>(op: Op) -> Op::Output {
    #[cfg(target_arch = "x86_64")]
    {
        use pulp::x86::{V3, V4};
        use std::sync::OnceLock;
        static WIDEST: OnceLock<(Option<V4>, Option<V3>)> = OnceLock::new();
        let (v4, v3) = *WIDEST.get_or_init(|| (V4::try_new(), V3::try_new()));
        let (v4, v3) = limit::limited(v4, v3);
        match (v4, v3) {
            (Some(v4), _) => return Simd::vectorize(v4, op),
            (None, Some(v3)) => return Simd::vectorize(v3, op),
            (None, None) => {}
        }
    }
    #[cfg(target_arch = "aarch64")]
    return pulp::Arch::new().dispatch(op);
    #[cfg(not(target_arch = "aarch64"))]
    Simd::vectorize(Scalar, op)
}

/// Numbers of 32 bits in the widest vector of this machine.
pub fn lanes() -> usize {
    struct Lanes;
    impl WithSimd for Lanes {
        type Output = usize;
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }
    dispatch(Lanes)
}

/// The vectors that arithmetic runs on here, by name. Sums of floats may differ in their last bits between two of these.
pub fn vectors() -> &'static str {
    match lanes() {
        16 => "AVX-512",
        8 => "AVX2",
        4 => "NEON",
        _ => "none",
    }
}

/// Compiles the closure for the widest vectors; what it calls must be `#[inline(always)]`.
#[inline]
pub fn vectorised<R>(f: impl FnOnce() -> R) -> R {
    dispatch(Run(f))
}

/// Asks for the cache line of `data[at]`, which may lie beyond the end.
#[inline(always)]
pub fn prefetch(data: &[f32], at: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use pulp::core_arch::x86::Sse;
        // every x86-64 has it: this is decided when compiling
        if let Some(sse) = Sse::try_new() {
            sse._mm_prefetch::<{ std::arch::x86_64::_MM_HINT_T0 }>(data.as_ptr().wrapping_add(at).cast());
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (data, at);
}

/// Sum of squares in a fixed order: sixteen running sums, joined every 4096 numbers in f64.
pub fn sum_of_squares(values: &[f32]) -> f64 {
    let mut total = 0.0f64;
    vectorised(
        #[inline(always)]
        || {
            for block in values.chunks(4096) {
                let mut lanes = [0f32; 16];
                let groups = block.chunks_exact(16);
                let rest: f32 = groups.remainder().iter().map(|x| x * x).sum();
                for group in groups {
                    for (lane, x) in lanes.iter_mut().zip(group) {
                        *lane += x * x;
                    }
                }
                total += f64::from(lanes.iter().sum::<f32>() + rest);
            }
        },
    );
    total
}

/// For tests: code for machines with less than this one has.
pub use limit::{Level, at_most};

mod limit {
    use std::cell::Cell;

    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
    pub enum Level {
        Scalar,
        Avx2,
        Avx512,
    }

    impl Level {
        pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Scalar];
    }

    thread_local!(static MOST: Cell<Level> = const { Cell::new(Level::Avx512) });

    /// Runs `f` as on a machine whose widest vectors are those of `level`; on this thread only.
    pub fn at_most<R>(level: Level, f: impl FnOnce() -> R) -> R {
        let before = MOST.replace(level);
        let result = f();
        MOST.set(before);
        result
    }

    pub fn limited<A, B>(v4: Option<A>, v3: Option<B>) -> (Option<A>, Option<B>) {
        let most = MOST.get();
        (v4.filter(|_| most >= Level::Avx512), v3.filter(|_| most >= Level::Avx2))
    }
}
