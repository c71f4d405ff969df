//! Standard normal draws by the hundred, the same bits on every machine and fast enough for a data set.
//!
//! [`Normals`](super::noise::Normals) draws one at a time and calls the platform's logarithm. Here sixty-four
//! generators run side by side (sfc32 of Chris Doty-Humphrey's PractRand: four words of state, the last one a counter),
//! and each pair of their words becomes two draws by Box and Muller's transform. Logarithm, sine and cosine are
//! polynomials of plain, fused and square-root arithmetic, all of which IEEE 754 rounds in one way only: the bits depend
//! neither on the width of the machine's vectors nor on its mathematical library.

use multiversion::multiversion;

/// Generators side by side.
const LANES: usize = 64;
/// Draws that come at once.
pub const BLOCK: usize = 2 * LANES;
/// Steps after which a generator's first words no longer show its seed; its author takes twelve.
const WARM_UP: usize = 15;

/// A series of independent draws of N(0, 1), each right to some 1e-6 of itself and cut off at 6.5.
#[derive(Debug, Clone)]
pub struct Gaussians {
    a: [u32; LANES],
    b: [u32; LANES],
    c: [u32; LANES],
    count: [u32; LANES],
}

/// The next state of a splitmix64 generator and its word (Steele, Lea and Flood 2014).
pub(super) fn splitmix(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// One number out of several, each of which changes all of its bits.
pub(super) fn mixed(parts: &[u64]) -> u64 {
    parts.iter().fold(0, |sum, part| {
        let mut state = sum ^ part;
        splitmix(&mut state)
    })
}

impl Gaussians {
    /// The series of this seed and of these numbers, as pair and frame: every set of them is a series of its own.
    pub fn new(seed: u64, numbers: [u64; 2]) -> Self {
        let mut state = mixed(&[seed, numbers[0], numbers[1]]);
        let mut words = || {
            std::array::from_fn(|_| {
                let word = splitmix(&mut state);
                (word >> 32) as u32 ^ word as u32
            })
        };
        let mut fresh = Self { a: words(), b: words(), c: words(), count: [1; LANES] };
        for _ in 0..WARM_UP {
            fresh.words();
        }
        fresh
    }

    #[inline(always)]
    fn words(&mut self) -> [u32; LANES] {
        let mut words = [0; LANES];
        for (lane, word) in words.iter_mut().enumerate() {
            let (a, b, c) = (self.a[lane], self.b[lane], self.c[lane]);
            *word = a.wrapping_add(b).wrapping_add(self.count[lane]);
            self.count[lane] = self.count[lane].wrapping_add(1);
            self.a[lane] = b ^ (b >> 9);
            self.b[lane] = c.wrapping_add(c << 3);
            self.c[lane] = c.rotate_left(21).wrapping_add(*word);
        }
        words
    }

    /// The next draws; a last block that is not filled loses its rest.
    pub fn fill(&mut self, draws: &mut [f32]) {
        let (blocks, rest) = draws.as_chunks_mut::<BLOCK>();
        fill(self, blocks);
        if !rest.is_empty() {
            let mut last = [[0.0; BLOCK]];
            fill(self, &mut last);
            rest.copy_from_slice(&last[0][..rest.len()]);
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn fill(series: &mut Gaussians, blocks: &mut [[f32; BLOCK]]) {
    for block in blocks {
        turn(series, block);
    }
}

/// Two words a lane become a radius and an angle, and these two draws.
#[inline(always)]
fn turn(series: &mut Gaussians, block: &mut [f32; BLOCK]) {
    let (lengths, angles) = (series.words(), series.words());
    let (first, second) = block.split_at_mut(LANES);
    for lane in 0..LANES {
        // −ln u of an odd number of 2⁻³¹ parts: never of nought. Its root is the radius over √2.
        let radius = minus_ln((lengths[lane] >> 1 | 1) as i32 as f32).max(0.0).sqrt();
        // An angle of ±π/4 about the diagonal, (cos ∓ sin) its two coordinates times √2, and a sign for each.
        let angle = (angles[lane] << 2) as i32 as f32 * (std::f32::consts::FRAC_PI_4 / (1_u32 << 31) as f32);
        let square = angle * angle;
        let sine = angle * polynomial(square, [0.999_998_57, -0.166_624_8, 0.008_151_635_5]);
        let cosine = polynomial(square, [1.0, -0.499_998_57, 0.041_655_026, -0.001_358_590_9]);
        let signs = angles[lane];
        first[lane] = signed(radius * (cosine - sine), signs);
        second[lane] = signed(radius * (cosine + sine), signs << 1);
    }
}

#[inline(always)]
fn signed(value: f32, sign: u32) -> f32 {
    f32::from_bits(value.to_bits() ^ (sign & 1 << 31))
}

/// −ln(x / 2³¹) for 1 ≤ x ≤ 2³¹, right to 1e-6 of itself.
#[inline(always)]
fn minus_ln(x: f32) -> f32 {
    const ROOT_HALF: u32 = 0x3f35_04f3;
    // x = 2ⁿ·(1 + f) with f between √½ − 1 and √2 − 1.
    let shifted = x.to_bits().wrapping_sub(ROOT_HALF);
    let power = (shifted as i32 >> 23) as f32;
    let f = f32::from_bits((shifted & 0x7f_ffff) + ROOT_HALF) - 1.0;
    let series = [1.000_001, -0.500_011_15, 0.333_145_08, -0.249_097_44, 0.204_963_31, -0.186_678_6, 0.118_961_09];
    let ln = f * polynomial(f, series);
    (31.0 - power).mul_add(std::f32::consts::LN_2, -ln)
}

/// c₀ + c₁·x + … by Horner's scheme.
#[inline(always)]
fn polynomial<const N: usize>(x: f32, coefficients: [f32; N]) -> f32 {
    let mut sum = coefficients[N - 1];
    for coefficient in coefficients[..N - 1].iter().rev() {
        sum = sum.mul_add(x, *coefficient);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_those_of_the_plain_loop() {
        let mut wide = Gaussians::new(7, [1, 2]);
        let mut plain = wide.clone();
        let mut draws = vec![0.0; 40 * BLOCK];
        wide.fill(&mut draws);
        for block in draws.as_chunks::<BLOCK>().0 {
            let mut expected = [0.0; BLOCK];
            turn(&mut plain, &mut expected);
            assert_eq!(block.map(f32::to_bits), expected.map(f32::to_bits));
        }
    }

    #[test]
    fn the_transform_is_box_and_mullers() {
        let mut series = Gaussians::new(9, [0, 0]);
        let mut words = series.clone();
        let mut draws = [0.0; BLOCK];
        for _ in 0..2000 {
            series.fill(&mut draws);
            let (lengths, angles) = (words.words(), words.words());
            for lane in 0..LANES {
                let u = f64::from(lengths[lane] >> 1 | 1) / f64::from(1_u32 << 31);
                let angle = f64::from((angles[lane] << 2) as i32) / 2_f64.powi(31) * std::f64::consts::FRAC_PI_4;
                let radius = (-2.0 * u.ln()).sqrt();
                let sign = |bit: u32| if angles[lane] << bit >> 31 == 1 { -1.0 } else { 1.0 };
                let turned = angle + std::f64::consts::FRAC_PI_4;
                let expected = [sign(0) * radius * turned.cos(), sign(1) * radius * turned.sin()];
                for (drawn, expected) in [draws[lane], draws[lane + LANES]].into_iter().zip(expected) {
                    assert!((f64::from(drawn) - expected).abs() < 1e-5, "{drawn} {expected}");
                }
            }
        }
    }

    #[test]
    fn the_ends_of_the_range_are_finite() {
        assert_eq!(minus_ln(2_147_483_648.0), 0.0);
        assert!((f64::from(minus_ln(1.0)) - 31.0 * std::f64::consts::LN_2).abs() < 1e-5);
        for power in 0..31 {
            for part in [1.0_f32, 1.2, 1.41, 1.42, 1.9] {
                let x = part * (1_u32 << power) as f32;
                let expected = 31.0 * std::f64::consts::LN_2 - f64::from(x).ln();
                assert!((f64::from(minus_ln(x)) / expected - 1.0).abs() < 3e-6, "{x}");
            }
        }
    }
}
