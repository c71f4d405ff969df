//! The loops that sum counts and apply the gain, shaped for the vectoriser and compiled for several instruction sets.
//!
//! Each output value is made of the same operations in the same order whatever the width of the vectors, and Rust
//! never contracts a multiplication and an addition, so all instruction sets give the same bits. Integer sums are
//! bounded by the largest whole factor; they are written as wrapping so that no check for overflow, where the build
//! has those, keeps the loops from being vectorised.

use multiversion::multiversion;

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn add(sums: &mut [u32], counts: &[u16]) {
    for (sum, count) in sums.iter_mut().zip(counts) {
        *sum = sum.wrapping_add(u32::from(*count));
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn add_weighted(sums: &mut [f32], counts: &[u16], black: f32, weight: f32) {
    for (sum, count) in sums.iter_mut().zip(counts) {
        *sum += (f32::from(*count) - black) * weight;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn raise(peaks: &mut [u16], counts: &[u16]) {
    for (peak, count) in peaks.iter_mut().zip(counts) {
        *peak = (*peak).max(*count);
    }
}

/// The linear value of a sum of `n` counts: exact up to the last rounding, which is to f32.
#[inline(always)]
fn linear(sum: u32, offset: f64, scale: f64) -> f32 {
    // A sum is below 2³¹ (see the largest whole factor), and vectors convert signed integers only.
    ((f64::from(sum as i32) - offset) * scale) as f32
}

/// Black's share in a sum of `n` counts, and the scale to 1 at white.
#[inline(always)]
fn levels(n: usize, [black, span]: [f32; 2]) -> [f64; 2] {
    [n as f64 * f64::from(black), 1.0 / (n as f64 * f64::from(span))]
}

/// A finished band by a whole factor, RGGB-like: `planes` are the colours at the cells' top left, of both greens, and
/// at the bottom right.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn whole_cells(factor: usize, rows: [&[u32]; 2], black_span: [f32; 2], planes: [&mut [f32]; 3]) {
    match factor {
        1 => cells_by(1, rows, black_span, planes),
        2 => cells_by(2, rows, black_span, planes),
        3 => cells_by(3, rows, black_span, planes),
        4 => cells_by(4, rows, black_span, planes),
        _ => cells_by(factor, rows, black_span, planes),
    }
}

#[inline(always)]
fn cells_by(factor: usize, [top, bottom]: [&[u32]; 2], black_span: [f32; 2], planes: [&mut [f32]; 3]) {
    let [outer_offset, outer_scale] = levels(factor * factor, black_span);
    let [green_offset, green_scale] = levels(2 * factor * factor, black_span);
    let [first, green, second] = planes;
    let columns = top.chunks_exact(2 * factor).zip(bottom.chunks_exact(2 * factor));
    for ((top, bottom), ((first, green), second)) in columns.zip(first.iter_mut().zip(green).zip(second)) {
        let mut sums = [0; 3];
        for i in 0..factor {
            sums[0] = top[2 * i].wrapping_add(sums[0]);
            sums[1] = top[2 * i + 1].wrapping_add(bottom[2 * i]).wrapping_add(sums[1]);
            sums[2] = bottom[2 * i + 1].wrapping_add(sums[2]);
        }
        *first = linear(sums[0], outer_offset, outer_scale);
        *green = linear(sums[1], green_offset, green_scale);
        *second = linear(sums[2], outer_offset, outer_scale);
    }
}

/// A finished band of monochrome by a whole factor.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn whole_mono(factor: usize, sums: &[u32], black_span: [f32; 2], plane: &mut [f32]) {
    let [offset, scale] = levels(factor * factor, black_span);
    if factor == 1 {
        for (value, sum) in plane.iter_mut().zip(sums) {
            *value = linear(*sum, offset, scale);
        }
        return;
    }
    for (value, sums) in plane.iter_mut().zip(sums.chunks_exact(factor)) {
        *value = linear(sums.iter().fold(0, |sum, value| value.wrapping_add(sum)), offset, scale);
    }
}

/// Joins a band's weighted columns to cells of three colours; the fourth value only fills the vector.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn join_cells(rows: [&[f32]; 2], cells: &mut [[f32; 4]]) {
    let (top, bottom) = (rows[0].as_chunks::<2>().0, rows[1].as_chunks::<2>().0);
    for (cell, (top, bottom)) in cells.iter_mut().zip(top.iter().zip(bottom)) {
        *cell = [top[0], (top[1] + bottom[0]) * 0.5, bottom[1], 0.0];
    }
}

/// A finished band of cells by any factor.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn mixed_cells(cells: &[[f32; 4]], taps: &[[u32; 2]], weights: &[f32], span: f32, planes: [&mut [f32]; 3]) {
    let scale = 1.0 / span;
    let [first, green, second] = planes;
    let mut weights = weights;
    for ((first, green), (second, tap)) in first.iter_mut().zip(green).zip(second.iter_mut().zip(taps)) {
        let [start, length] = tap.map(|tap| tap as usize);
        let (ours, rest) = weights.split_at(length);
        weights = rest;
        let mut sum = [0.0f32; 4];
        for (cell, weight) in cells[start..][..length].iter().zip(ours) {
            for i in 0..4 {
                sum[i] += cell[i] * weight;
            }
        }
        *first = sum[0] * scale;
        *green = sum[1] * scale;
        *second = sum[2] * scale;
    }
}

/// A finished band of monochrome by any factor.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn mixed_mono(sums: &[f32], taps: &[[u32; 2]], weights: &[f32], span: f32, plane: &mut [f32]) {
    let scale = 1.0 / span;
    let mut weights = weights;
    for (value, tap) in plane.iter_mut().zip(taps) {
        let [start, length] = tap.map(|tap| tap as usize);
        let (ours, rest) = weights.split_at(length);
        weights = rest;
        let sum: f32 = sums[start..][..length].iter().zip(ours).map(|(value, weight)| value * weight).sum();
        *value = sum * scale;
    }
}

/// The sum of all values, in 32 fixed lanes.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn total(values: &[f32]) -> f64 {
    let (blocks, rest) = values.as_chunks::<32>();
    let mut lanes = [0.0f64; 32];
    for block in blocks {
        for i in 0..32 {
            lanes[i] += f64::from(block[i]);
        }
    }
    let rest: f64 = rest.iter().map(|value| f64::from(*value)).sum();
    lanes.iter().sum::<f64>() + rest
}

/// The gain, then the clip: the only step that is not linear comes last.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn brighten(reduced: &[f32], gain: f32, rgb: &mut [f32]) {
    for (out, value) in rgb.iter_mut().zip(reduced) {
        *out = (value * gain).clamp(0.0, 1.0);
    }
}
