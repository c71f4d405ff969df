//! Products of tiles by AVX-512's dot products of two numbers of bf16 each.

use std::arch::x86_64::*;

use super::tiles::{Block, LANES, Line, SIDE, STEP, Sums};

/// Pixels whose sums are in registers at once, each in two of them.
const PIXELS: usize = 8;

/// The sums over all steps, which with `add` go on from what they are. Of its own, so that it has the registers to itself.
#[inline(never)]
#[target_feature(enable = "avx512f,avx512bf16")]
pub fn multiply(block: &Block<'_>, add: bool, sums: &mut Sums) {
    for half in 0..2 {
        for first in (0..SIDE).step_by(PIXELS) {
            some(block, [half, first], add, sums);
        }
    }
}

/// Those of eight pixels of a half.
#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn some(block: &Block<'_>, [half, first]: [usize; 2], add: bool, sums: &mut Sums) {
    let Block { pixels, starts, stride, offsets, weights } = *block;
    let mut near = [_mm512_setzero_ps(); PIXELS];
    let mut far = near;
    if add {
        macro_rules! each {
            ($($k:literal)*) => { $(
                near[$k] = load(&sums.0[2 * half][first + $k]);
                far[$k] = load(&sums.0[2 * half + 1][first + $k]);
            )* };
        }
        each!(0 1 2 3 4 5 6 7);
    }
    for (offset, weights) in offsets.iter().zip(weights.chunks_exact(STEP)) {
        let start = starts[half] + offset + first * stride;
        let mut lines = [&Line::ZERO; PIXELS];
        for (k, line) in lines.iter_mut().enumerate() {
            *line = &pixels[start + k * stride];
        }
        let (low, high) = weights.split_at(SIDE);
        for (two, (low, high)) in low.iter().zip(high).enumerate().take(LANES / 2) {
            let (low, high) = (vector(low), vector(high));
            // Written out, for a loop may leave the sums in memory.
            macro_rules! each {
                ($($k:literal)*) => { $(
                    let value = both(lines[$k], two);
                    near[$k] = _mm512_dpbf16_ps(near[$k], value, low);
                    far[$k] = _mm512_dpbf16_ps(far[$k], value, high);
                )* };
            }
            each!(0 1 2 3 4 5 6 7);
        }
    }
    macro_rules! each {
        ($($k:literal)*) => { $(
            store(near[$k], &mut sums.0[2 * half][first + $k]);
            store(far[$k], &mut sums.0[2 * half + 1][first + $k]);
        )* };
    }
    each!(0 1 2 3 4 5 6 7);
}

#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn vector(line: &Line) -> __m512bh {
    // SAFETY: a line is as large and as aligned as a register, and any bits are numbers of bf16.
    unsafe { std::mem::transmute(_mm512_load_si512(std::ptr::from_ref(line).cast())) }
}

/// Two neighbouring numbers of a line, in every place.
#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn both(Line(numbers): &Line, two: usize) -> __m512bh {
    let bits = u32::from(numbers[2 * two]) | u32::from(numbers[2 * two + 1]) << 16;
    // SAFETY: registers of one size, and any bits are numbers of bf16.
    unsafe { std::mem::transmute(_mm512_set1_epi32(bits.cast_signed())) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn load(from: &[f32; SIDE]) -> __m512 {
    // SAFETY: there are 16 numbers.
    unsafe { _mm512_loadu_ps(from.as_ptr()) }
}

#[inline]
#[target_feature(enable = "avx512f")]
fn store(sums: __m512, to: &mut [f32; SIDE]) {
    // SAFETY: there is room for 16 numbers.
    unsafe { _mm512_storeu_ps(to.as_mut_ptr(), sums) }
}
