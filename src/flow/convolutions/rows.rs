//! What is done to rows of pixels between two convolutions, by AVX-512 where the tiles are AMX's.
//!
//! Written with intrinsics, for what the compiler makes of the plain forms takes longer than the convolutions themselves.

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
use std::arch::x86_64::*;

use super::tiles::{LANES, Line, SIDE, narrowed, widened};

/// A line's numbers in 32 bits.
pub type Wide = [f32; LANES];

/// What each channel is multiplied with, and what is added then.
pub type Norm<'a> = [&'a Wide; 2];

/// Sums of some pixels with the lower and the upper 16 channels of a line.
pub type Halves<'a> = [&'a [[f32; SIDE]]; 2];

/// Where a convolution's results go to.
#[derive(Debug)]
pub struct Results<'a> {
    /// The map's pixels, `depth` lines each, of which the first is written.
    pub map: Option<(&'a mut [Line], usize)>,
    /// As they are.
    pub wide: Option<&'a mut [Wide; SIDE]>,
    /// To these their sums are added, and those of their squares, before the activation.
    pub totals: Option<&'a mut [Wide; 2]>,
}

/// Bias, sums, and an activation that multiplies what is negative with `slope`, which is at most 1.
#[inline(always)]
pub fn finish(fast: bool, sums: Halves<'_>, bias: &Wide, slope: f32, to: Results<'_>) {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if fast {
        // SAFETY: the caller has seen that the processor has these vectors.
        return unsafe { finish_by_vectors(sums, bias, slope, to) };
    }
    let _ = fast;
    let [low, high] = sums;
    let Results { mut map, mut wide, mut totals } = to;
    for (pixel, (low, high)) in low.iter().zip(high).enumerate() {
        let mut values: Wide = std::array::from_fn(|i| bias[i] + if i < SIDE { low[i] } else { high[i - SIDE] });
        if let Some([totals, squares]) = &mut totals {
            for i in 0..LANES {
                totals[i] += values[i];
                squares[i] += values[i] * values[i];
            }
        }
        values.iter_mut().for_each(|value| *value = value.max(slope * *value));
        if let Some((map, depth)) = &mut map {
            map[pixel * *depth] = Line(values.map(narrowed));
        }
        if let Some(wide) = &mut wide {
            wide[pixel] = values;
        }
    }
}

/// ReLU(norm(row)) for one line of each pixel, and if there is a short cut, ReLU(that + norm(short)).
#[inline(always)]
pub fn join(fast: bool, row: &mut [Line], depth: usize, norm: Norm<'_>, short: Option<(&[Line], Norm<'_>)>) {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if fast {
        // SAFETY: the caller has seen that the processor has these vectors.
        return unsafe { join_by_vectors(row, depth, norm, short) };
    }
    let _ = fast;
    for (pixel, line) in row.iter_mut().step_by(depth).enumerate() {
        let normed = |[scale, shift]: Norm<'_>, Line(from): &Line| -> Wide {
            std::array::from_fn(|i| widened(from[i]).mul_add(scale[i], shift[i]))
        };
        let mut values = normed(norm, line).map(|value| value.max(0.0));
        if let Some((short, norm)) = short {
            let short = normed(norm, &short[pixel * depth]);
            values = std::array::from_fn(|i| (values[i] + short[i]).max(0.0));
        }
        *line = Line(values.map(narrowed));
    }
}

/// The rows of 32 channels; nothing where there is no such channel.
pub type Channels<'a> = [Option<&'a [f32]>; LANES];

/// One line of each pixel, `depth` lines apart, from rows of planes. All rows are as long as there are pixels.
#[inline(always)]
pub fn pack(fast: bool, channels: &Channels<'_>, to: &mut [Line], depth: usize) {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if fast && to.len().div_ceil(depth) >= SIDE {
        // SAFETY: the caller has seen that the processor has these vectors.
        return unsafe { pack_by_vectors(channels, to, depth) };
    }
    let _ = fast;
    for (x, line) in to.iter_mut().step_by(depth).enumerate() {
        *line = Line(channels.map(|row| row.map_or(0, |row| narrowed(row[x]))));
    }
}

/// The results of up to 16 pixels as a row for each of so many channels, which `each` gets with its number.
#[inline(always)]
pub fn spread(fast: bool, results: &[Wide], channels: usize, mut each: impl FnMut(usize, &[f32])) {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if let (true, Some(results)) = (fast, <&[Wide; SIDE]>::try_from(results).ok()) {
        let mut turned = [[0.0; SIDE]; LANES];
        // SAFETY: the caller has seen that the processor has these vectors.
        unsafe { turn_results(results, &mut turned) };
        for (channel, row) in turned.iter().enumerate().take(channels) {
            each(channel, row);
        }
        return;
    }
    let _ = fast;
    for channel in 0..channels {
        let mut row = [0.0; SIDE];
        row.iter_mut().zip(results).for_each(|(to, result)| *to = result[channel]);
        each(channel, &row[..results.len()]);
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod vectors {
    use super::*;

    /// Rows of 16 numbers become columns.
    #[target_feature(enable = "avx512f")]
    pub fn turn(rows: &mut [__m512i; SIDE]) {
        let mut a = *rows;
        for i in 0..SIDE / 2 {
            a[2 * i] = _mm512_unpacklo_epi32(rows[2 * i], rows[2 * i + 1]);
            a[2 * i + 1] = _mm512_unpackhi_epi32(rows[2 * i], rows[2 * i + 1]);
        }
        let mut b = a;
        for i in 0..SIDE / 4 {
            b[4 * i] = _mm512_unpacklo_epi64(a[4 * i], a[4 * i + 2]);
            b[4 * i + 1] = _mm512_unpackhi_epi64(a[4 * i], a[4 * i + 2]);
            b[4 * i + 2] = _mm512_unpacklo_epi64(a[4 * i + 1], a[4 * i + 3]);
            b[4 * i + 3] = _mm512_unpackhi_epi64(a[4 * i + 1], a[4 * i + 3]);
        }
        // b[4 i + j] has columns j, 4 + j, 8 + j, 12 + j of rows 4 i to 4 i + 3.
        for j in 0..4 {
            let low = _mm512_shuffle_i32x4::<0x88>(b[j], b[4 + j]);
            let high = _mm512_shuffle_i32x4::<0x88>(b[8 + j], b[12 + j]);
            rows[j] = _mm512_shuffle_i32x4::<0x88>(low, high);
            rows[8 + j] = _mm512_shuffle_i32x4::<0xdd>(low, high);
            let low = _mm512_shuffle_i32x4::<0xdd>(b[j], b[4 + j]);
            let high = _mm512_shuffle_i32x4::<0xdd>(b[8 + j], b[12 + j]);
            rows[4 + j] = _mm512_shuffle_i32x4::<0x88>(low, high);
            rows[12 + j] = _mm512_shuffle_i32x4::<0xdd>(low, high);
        }
    }

    /// Both halves of a line's numbers.
    #[target_feature(enable = "avx512f")]
    pub fn load(from: &Wide) -> [__m512; 2] {
        // SAFETY: 32 numbers are there to be read.
        unsafe { [_mm512_loadu_ps(from.as_ptr()), _mm512_loadu_ps(from[SIDE..].as_ptr())] }
    }

    #[target_feature(enable = "avx512f")]
    pub fn store(values: [__m512; 2], to: &mut Wide) {
        // SAFETY: there is room for 32 numbers.
        unsafe {
            _mm512_storeu_ps(to.as_mut_ptr(), values[0]);
            _mm512_storeu_ps(to[SIDE..].as_mut_ptr(), values[1]);
        }
    }

    #[target_feature(enable = "avx512f")]
    pub fn widen(Line(from): &Line) -> [__m512; 2] {
        // SAFETY: a line has 64 bytes, and begins at a multiple of so many.
        let line = unsafe { _mm512_load_si512(from.as_ptr().cast()) };
        let of = |half: __m256i| _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(half)));
        [of(_mm512_castsi512_si256(line)), of(_mm512_extracti64x4_epi64::<1>(line))]
    }

    #[target_feature(enable = "avx512f,avx512bf16")]
    pub fn narrow(values: [__m512; 2]) -> Line {
        // SAFETY: both are 64 bytes of any content.
        unsafe { std::mem::transmute::<__m512bh, Line>(_mm512_cvtne2ps_pbh(values[1], values[0])) }
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[target_feature(enable = "avx512f,avx512bf16")]
fn finish_by_vectors(sums: Halves<'_>, bias: &Wide, slope: f32, to: Results<'_>) {
    let [low, high] = sums;
    let Results { mut map, mut wide, totals } = to;
    let (bias, slope) = (vectors::load(bias), _mm512_set1_ps(slope));
    let zero = [_mm512_setzero_ps(); 2];
    let (mut sums, mut squares) = (zero, zero);
    for (pixel, (low, high)) in low.iter().zip(high).enumerate() {
        // SAFETY: 16 numbers are there to be read.
        let tiles = unsafe { [_mm512_loadu_ps(low.as_ptr()), _mm512_loadu_ps(high.as_ptr())] };
        let mut values = zero;
        for i in 0..2 {
            let value = _mm512_add_ps(tiles[i], bias[i]);
            sums[i] = _mm512_add_ps(sums[i], value);
            squares[i] = _mm512_fmadd_ps(value, value, squares[i]);
            values[i] = _mm512_max_ps(value, _mm512_mul_ps(value, slope));
        }
        if let Some((map, depth)) = &mut map {
            map[pixel * *depth] = vectors::narrow(values);
        }
        if let Some(wide) = &mut wide {
            vectors::store(values, &mut wide[pixel]);
        }
    }
    if let Some([to_sums, to_squares]) = totals {
        for (to, more) in [(to_sums, sums), (to_squares, squares)] {
            let before = vectors::load(to);
            vectors::store([_mm512_add_ps(before[0], more[0]), _mm512_add_ps(before[1], more[1])], to);
        }
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[target_feature(enable = "avx512f,avx512bf16")]
fn join_by_vectors(row: &mut [Line], depth: usize, norm: Norm<'_>, short: Option<(&[Line], Norm<'_>)>) {
    let zero = _mm512_setzero_ps();
    let norm = norm.map(|of| vectors::load(of));
    let short = short.map(|(short, norm)| (short, norm.map(|of| vectors::load(of))));
    for (pixel, line) in row.iter_mut().step_by(depth).enumerate() {
        let mut values = vectors::widen(line);
        for i in 0..2 {
            values[i] = _mm512_max_ps(_mm512_fmadd_ps(values[i], norm[0][i], norm[1][i]), zero);
        }
        if let Some((short, norm)) = &short {
            let other = vectors::widen(&short[pixel * depth]);
            for i in 0..2 {
                let other = _mm512_fmadd_ps(other[i], norm[0][i], norm[1][i]);
                values[i] = _mm512_max_ps(_mm512_add_ps(values[i], other), zero);
            }
        }
        *line = vectors::narrow(values);
    }
}

/// Two channels of a pixel side by side are a number of 32 bits; 16 such rows, turned, are a line of each of 16 pixels.
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn pack_by_vectors(channels: &Channels<'_>, to: &mut [Line], depth: usize) {
    let pixels = to.len().div_ceil(depth);
    // Of the first 16 and the last 16 numbers, one by one in turn.
    let alternate: [u16; LANES] = std::array::from_fn(|i| (i / 2 + i % 2 * SIDE) as u16);
    // SAFETY: 64 bytes of any content.
    let alternate = unsafe { std::mem::transmute::<[u16; LANES], __m512i>(alternate) };
    for x in (0..pixels).step_by(SIDE) {
        // The last block begins earlier, rather than reach beyond the row.
        let x = x.min(pixels - SIDE);
        let load = |row: Option<&[f32]>| match row {
            // SAFETY: the slice has 16 numbers.
            Some(row) => unsafe { _mm512_loadu_ps(row[x..x + SIDE].as_ptr()) },
            None => _mm512_setzero_ps(),
        };
        let mut rows = [_mm512_setzero_si512(); SIDE];
        for (row, two) in rows.iter_mut().zip(channels.as_chunks::<2>().0) {
            if two[0].is_none() && two[1].is_none() {
                continue;
            }
            let both = _mm512_cvtne2ps_pbh(load(two[1]), load(two[0]));
            // SAFETY: as above.
            let both = unsafe { std::mem::transmute::<__m512bh, __m512i>(both) };
            *row = _mm512_permutexvar_epi16(alternate, both);
        }
        vectors::turn(&mut rows);
        for (pixel, row) in rows.into_iter().enumerate() {
            // SAFETY: as above.
            to[(x + pixel) * depth] = unsafe { std::mem::transmute::<__m512i, Line>(row) };
        }
    }
}

#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
#[target_feature(enable = "avx512f")]
fn turn_results(results: &[Wide; SIDE], to: &mut [[f32; SIDE]; LANES]) {
    for half in 0..2 {
        let mut rows = [_mm512_setzero_si512(); SIDE];
        for (row, result) in rows.iter_mut().zip(results) {
            *row = _mm512_castps_si512(vectors::load(result)[half]);
        }
        vectors::turn(&mut rows);
        for (row, to) in rows.into_iter().zip(&mut to[half * SIDE..]) {
            // SAFETY: there is room for 16 numbers.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), _mm512_castsi512_ps(row)) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::convolutions::Unit;

    /// Numbers that bf16 has exactly.
    fn row(seed: usize, count: usize) -> Vec<f32> {
        (0..count).map(|x| ((seed * 37 + x * 11) % 128) as f32 - 64.0).collect()
    }

    #[test]
    fn rows_become_pixels_and_pixels_rows() {
        for (count, depth) in [(1, 1), (16, 1), (20, 3), (40, 2), (64, 1)] {
            for fast in Unit::all().into_iter().map(Unit::is_fast) {
                let rows: Vec<Vec<f32>> = (0..LANES).map(|c| row(c, count)).collect();
                let channels = std::array::from_fn(|c| (c % 7 != 3).then_some(&rows[c][..]));
                let mut lines = vec![Line([9; LANES]); count * depth];
                pack(fast, &channels, &mut lines, depth);
                for (i, line) in lines.iter().enumerate() {
                    let wanted = |c: usize| if c % 7 == 3 { 0.0 } else { rows[c][i / depth] };
                    let untouched = i % depth > 0;
                    for (c, value) in line.0.iter().enumerate() {
                        assert!(if untouched { *value == 9 } else { widened(*value) == wanted(c) }, "{i} {c}");
                    }
                }
                let mut planes = vec![vec![0.0; SIDE]; 29];
                let mut wide = [[0.0; LANES]; SIDE];
                let some = count.min(SIDE);
                for (wide, Line(line)) in wide.iter_mut().zip(lines.iter().step_by(depth)) {
                    *wide = line.map(widened);
                }
                spread(fast, &wide[..some], 29, |c, row| planes[c][..some].copy_from_slice(row));
                for (c, plane) in planes.iter().enumerate() {
                    for (x, value) in plane.iter().enumerate().take(some) {
                        assert_eq!(*value, if c % 7 == 3 { 0.0 } else { rows[c][x] });
                    }
                }
            }
        }
    }
}
