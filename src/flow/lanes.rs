//! Vectors of f32 of this processor: AVX-512, AVX2 with FMA, NEON, or what the compiler makes of arrays.
//!
//! Compilers turn the inner loop of a cost volume into shuffles that cost more than the sums; hence intrinsics. A value
//! of a type that implements [`Lanes`] is the proof that the processor has what its methods need, so that they are safe.

#[cfg(target_arch = "aarch64")]
use std::arch::aarch64::*;
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::*;

/// Arithmetic on `COUNT` numbers at once.
pub trait Lanes: Copy + Send + Sync {
    /// How many numbers a vector has, at most [`MOST`].
    const COUNT: usize;
    /// The numbers.
    type V: Copy;

    /// Runs a piece of work that was compiled for this processor.
    fn enter<W: Work>(self, work: W);
    /// The same number in every lane.
    fn splat(self, value: f32) -> Self::V;
    /// The first `COUNT` numbers.
    fn load(self, from: &[f32]) -> Self::V;
    /// To the first `COUNT` places.
    fn store(self, v: Self::V, to: &mut [f32]);
    /// a + b
    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    /// a − b
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    /// a · b
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    /// a / b
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// a · b + c
    fn fused(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The greater one; `b` where they don't compare.
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    /// Rows of eight, `from_stride` apart, become columns; their rows are `to_stride` apart.
    #[inline(always)]
    fn turn(self, from: &[f32], from_stride: usize, to: &mut [f32], to_stride: usize) {
        for i in 0..TILE {
            for j in 0..TILE {
                to[j * to_stride + i] = from[i * from_stride + j];
            }
        }
    }
    /// 2ⁿ where `v` is 1.5 · 2²³ + n, for −126 ≤ n ≤ 127: n stands in the lowest bits, and goes to where exponents are.
    fn power(self, v: Self::V) -> Self::V;
}

/// The most numbers that a vector has.
pub const MOST: usize = 16;
/// Rows and columns that are turned at once.
pub const TILE: usize = 8;

/// Something to be done with the vectors that there are. Implementations must be `#[inline(always)]`, for the processor's
/// features are those of the function that they are inlined into.
pub trait Work {
    /// Does it.
    fn on<L: Lanes>(self, lanes: L);
}

/// What this processor has.
#[derive(Debug, Clone, Copy)]
pub enum Unit {
    /// Arrays, for the compiler to see to.
    Plain(Plain),
    #[cfg(target_arch = "x86_64")]
    /// 8 lanes.
    Avx2(Avx2),
    #[cfg(target_arch = "x86_64")]
    /// 16 lanes.
    Avx512(Avx512),
    #[cfg(target_arch = "aarch64")]
    /// 4 lanes.
    Neon(Neon),
}

impl Unit {
    /// All that this processor has.
    #[cfg(test)]
    pub fn all() -> Vec<Unit> {
        let mut all = vec![Unit::Plain(Plain)];
        #[cfg(target_arch = "x86_64")]
        {
            all.extend(Avx2::new().map(Unit::Avx2));
            all.extend(Avx512::new().map(Unit::Avx512));
        }
        #[cfg(target_arch = "aarch64")]
        all.extend(Neon::new().map(Unit::Neon));
        all
    }

    /// The fastest that this processor has.
    pub fn best() -> Unit {
        #[cfg(target_arch = "x86_64")]
        let found = Avx512::new().map(Unit::Avx512).or_else(|| Avx2::new().map(Unit::Avx2));
        #[cfg(target_arch = "aarch64")]
        let found = Neon::new().map(Unit::Neon);
        #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
        let found = None;
        found.unwrap_or(Unit::Plain(Plain))
    }

    /// Does a piece of work.
    pub fn run(self, work: impl Work) {
        match self {
            Unit::Plain(lanes) => lanes.enter(work),
            #[cfg(target_arch = "x86_64")]
            Unit::Avx2(lanes) => lanes.enter(work),
            #[cfg(target_arch = "x86_64")]
            Unit::Avx512(lanes) => lanes.enter(work),
            #[cfg(target_arch = "aarch64")]
            Unit::Neon(lanes) => lanes.enter(work),
        }
    }
}

/// Arrays of eight: two registers of SSE2, which every x86-64 has.
#[derive(Debug, Clone, Copy)]
pub struct Plain;

impl Lanes for Plain {
    const COUNT: usize = 8;
    type V = [f32; 8];

    fn enter<W: Work>(self, work: W) {
        work.on(self);
    }
    #[inline(always)]
    fn splat(self, value: f32) -> [f32; 8] {
        [value; 8]
    }
    #[inline(always)]
    fn load(self, from: &[f32]) -> [f32; 8] {
        std::array::from_fn(|i| from[i])
    }
    #[inline(always)]
    fn store(self, v: [f32; 8], to: &mut [f32]) {
        to[..8].copy_from_slice(&v);
    }
    #[inline(always)]
    fn add(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] - b[i])
    }
    #[inline(always)]
    fn mul(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    fn div(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] / b[i])
    }
    // Rounded twice: without the instruction a fused one is a call into the C library.
    #[inline(always)]
    fn fused(self, a: [f32; 8], b: [f32; 8], c: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn max(self, a: [f32; 8], b: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn power(self, v: [f32; 8]) -> [f32; 8] {
        v.map(|v| f32::from_bits((v.to_bits() << 23).wrapping_add(1.0f32.to_bits())))
    }
}

/// Implements [`Lanes`] by intrinsics, each of which takes and gives registers alone.
macro_rules! by_intrinsics {
    (
        $name:ident, $count:literal, $register:ty, $features:literal,
        $splat:path, $load:path, $store:path, $add:path, $sub:path, $mul:path, $div:path, $fused:expr, $max:expr, $power:expr
        $(, $turn:path)?
    ) => {
        #[doc = concat!("Proof that there is ", $features, ".")]
        #[derive(Debug, Clone, Copy)]
        pub struct $name(());

        // Where a feature is part of the target, as NEON is of aarch64, its intrinsics are safe.
        #[allow(unused_unsafe)]
        impl Lanes for $name {
            const COUNT: usize = $count;
            type V = $register;

            fn enter<W: Work>(self, work: W) {
                // Of its own, so that a piece of work has the registers to itself.
                #[inline(never)]
                #[target_feature(enable = $features)]
                fn within<W: Work>(lanes: $name, work: W) {
                    work.on(lanes);
                }
                // SAFETY: the features are there, as `self` proves.
                unsafe { within(self, work) }
            }
            #[inline(always)]
            fn splat(self, value: f32) -> $register {
                // SAFETY: as above, here and in every method.
                unsafe { $splat(value) }
            }
            #[inline(always)]
            fn load(self, from: &[f32]) -> $register {
                let from = &from[..$count];
                // SAFETY: and so many numbers are there to be read, at any alignment.
                unsafe { $load(from.as_ptr()) }
            }
            #[inline(always)]
            fn store(self, v: $register, to: &mut [f32]) {
                let to = &mut to[..$count];
                // SAFETY: and there is room for so many, at any alignment.
                unsafe { $store(to.as_mut_ptr(), v) }
            }
            #[inline(always)]
            fn add(self, a: $register, b: $register) -> $register {
                // SAFETY: as above.
                unsafe { $add(a, b) }
            }
            #[inline(always)]
            fn sub(self, a: $register, b: $register) -> $register {
                // SAFETY: as above.
                unsafe { $sub(a, b) }
            }
            #[inline(always)]
            fn mul(self, a: $register, b: $register) -> $register {
                // SAFETY: as above.
                unsafe { $mul(a, b) }
            }
            #[inline(always)]
            fn div(self, a: $register, b: $register) -> $register {
                // SAFETY: as above.
                unsafe { $div(a, b) }
            }
            #[inline(always)]
            fn fused(self, a: $register, b: $register, c: $register) -> $register {
                // SAFETY: as above.
                unsafe { $fused(a, b, c) }
            }
            #[inline(always)]
            fn max(self, a: $register, b: $register) -> $register {
                // SAFETY: as above.
                unsafe { $max(a, b) }
            }
            $(#[inline(always)]
            fn turn(self, from: &[f32], from_stride: usize, to: &mut [f32], to_stride: usize) {
                // SAFETY: as above.
                unsafe { $turn(from, from_stride, to, to_stride) }
            })?
            #[inline(always)]
            fn power(self, v: $register) -> $register {
                // SAFETY: as above.
                unsafe { $power(v) }
            }
        }
    };
}

/// The bits of 1.
const ONE: i32 = 1.0f32.to_bits() as i32;

#[cfg(target_arch = "x86_64")]
by_intrinsics!(
    Avx2,
    8,
    __m256,
    "avx2,fma",
    _mm256_set1_ps,
    _mm256_loadu_ps,
    _mm256_storeu_ps,
    _mm256_add_ps,
    _mm256_sub_ps,
    _mm256_mul_ps,
    _mm256_div_ps,
    _mm256_fmadd_ps,
    _mm256_max_ps,
    |v| _mm256_castsi256_ps(_mm256_add_epi32(_mm256_slli_epi32::<23>(_mm256_castps_si256(v)), _mm256_set1_epi32(ONE))),
    turn_by_avx
);

#[cfg(target_arch = "x86_64")]
by_intrinsics!(
    Avx512,
    16,
    __m512,
    "avx512f,fma",
    _mm512_set1_ps,
    _mm512_loadu_ps,
    _mm512_storeu_ps,
    _mm512_add_ps,
    _mm512_sub_ps,
    _mm512_mul_ps,
    _mm512_div_ps,
    _mm512_fmadd_ps,
    _mm512_max_ps,
    |v| _mm512_castsi512_ps(_mm512_add_epi32(_mm512_slli_epi32::<23>(_mm512_castps_si512(v)), _mm512_set1_epi32(ONE))),
    turn_by_avx
);

#[cfg(target_arch = "aarch64")]
by_intrinsics!(
    Neon,
    4,
    float32x4_t,
    "neon",
    vdupq_n_f32,
    vld1q_f32,
    vst1q_f32,
    vaddq_f32,
    vsubq_f32,
    vmulq_f32,
    vdivq_f32,
    |a, b, c| vfmaq_f32(c, a, b),
    |a, b| vbslq_f32(vcgtq_f32(a, b), a, b),
    |v| vreinterpretq_f32_s32(vaddq_s32(vshlq_n_s32::<23>(vreinterpretq_s32_f32(v)), vdupq_n_s32(ONE)))
);

#[cfg(target_arch = "x86_64")]
impl Avx2 {
    /// If the processor has it.
    pub fn new() -> Option<Self> {
        (is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
}

#[cfg(target_arch = "x86_64")]
impl Avx512 {
    /// If the processor has it.
    pub fn new() -> Option<Self> {
        (is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("fma")).then_some(Self(()))
    }
}

#[cfg(target_arch = "aarch64")]
impl Neon {
    /// If the processor has it.
    pub fn new() -> Option<Self> {
        std::arch::is_aarch64_feature_detected!("neon").then_some(Self(()))
    }
}

/// See [`Lanes::turn`].
#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx2")]
fn turn_by_avx(from: &[f32], from_stride: usize, to: &mut [f32], to_stride: usize) {
    let row = |i: usize| {
        let row = &from[i * from_stride..][..TILE];
        // SAFETY: eight numbers are there to be read.
        unsafe { _mm256_loadu_ps(row.as_ptr()) }
    };
    // Pairs of rows, then fours, each within both halves of a register; then the halves change places.
    let fours = |i: usize| {
        let [a, b, c, d] = [row(i), row(i + 1), row(i + 2), row(i + 3)];
        let (low, high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
        let (next_low, next_high) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
        [
            _mm256_shuffle_ps::<0x44>(low, next_low),
            _mm256_shuffle_ps::<0xee>(low, next_low),
            _mm256_shuffle_ps::<0x44>(high, next_high),
            _mm256_shuffle_ps::<0xee>(high, next_high),
        ]
    };
    let (upper, lower) = (fours(0), fours(4));
    for (i, (upper, lower)) in upper.into_iter().zip(lower).enumerate() {
        let near = _mm256_permute2f128_ps::<0x20>(upper, lower);
        let far = _mm256_permute2f128_ps::<0x31>(upper, lower);
        for (i, column) in [(i, near), (i + 4, far)] {
            let to = &mut to[i * to_stride..][..TILE];
            // SAFETY: there is room for eight numbers.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), column) }
        }
    }
}

/// Has the cache lines brought near that these numbers lie in, where a processor can be asked to.
#[inline(always)]
pub fn fetch(numbers: &[f32]) {
    #[cfg(target_arch = "x86_64")]
    for number in numbers.iter().step_by(MOST) {
        // SAFETY: every x86-64 has the instruction, which changes nothing but what is in the caches.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(number).cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = numbers;
}

/// e to the power of numbers of −87 to 0, and e⁻⁸⁷ for smaller ones; not-a-number stays so. To 5e-7 of 1.
#[inline(always)]
pub fn exp<L: Lanes>(lanes: L, x: L::V) -> L::V {
    const MAGIC: f32 = 12_582_912.0;
    let x = lanes.max(lanes.splat(-87.0), x);
    let scale = lanes.splat(std::f32::consts::LOG2_E);
    let shifted = lanes.fused(x, scale, lanes.splat(MAGIC));
    let whole = lanes.sub(shifted, lanes.splat(MAGIC));
    // |rest| ≤ ½, and the powers of ln 2 over the factorials up to the sixth.
    let rest = lanes.fused(x, scale, lanes.sub(lanes.splat(0.0), whole));
    let mut sum = lanes.splat(1.540_353e-4);
    for coefficient in [1.333_355_8e-3, 9.618_129e-3, 5.550_411e-2, 0.240_226_5, std::f32::consts::LN_2, 1.0] {
        sum = lanes.fused(sum, rest, lanes.splat(coefficient));
    }
    lanes.mul(sum, lanes.power(shifted))
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Exp<'a>(&'a mut [f32]);

    impl Work for Exp<'_> {
        #[inline(always)]
        fn on<L: Lanes>(self, lanes: L) {
            for values in self.0.chunks_exact_mut(L::COUNT) {
                lanes.store(exp(lanes, lanes.load(values)), values);
            }
        }
    }

    #[test]
    fn the_exponential_is_right_to_a_millionth_where_it_counts() {
        for unit in Unit::all() {
            let x: Vec<f32> = (0..8688).map(|i| -0.01 * i as f32).collect();
            let mut found = x.clone();
            unit.run(Exp(&mut found));
            for (x, found) in x.iter().zip(&found) {
                let wanted = f64::from(*x).exp();
                // Without a fused product the exponent's own rounding grows with it.
                let allowed = 5e-7 + 1e-7 * f64::from(x.abs());
                assert!((f64::from(*found) / wanted - 1.0).abs() < allowed, "{unit:?}: e^{x} is {found}, not {wanted}");
            }
            let mut odd = vec![f32::NAN, f32::NEG_INFINITY, -1e30, 0.0];
            odd.resize(MOST, 0.0);
            unit.run(Exp(&mut odd));
            assert!(odd[0].is_nan() && odd[1] < 1e-37 && odd[2] < 1e-37 && odd[3] == 1.0, "{odd:?}");
        }
    }
}
