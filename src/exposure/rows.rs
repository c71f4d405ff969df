//! One row of the mosaic at a time: bytes become counts, and what the row says of itself is measured.
//!
//! Every loop here is shaped for the compiler's vectoriser and compiled for several instruction sets. All arithmetic is
//! on integers, so the results do not depend on which of them runs.

use multiversion::multiversion;

use super::{
    Packing,
    layout::{Container, Layout},
};

/// What a row (or a frame, by [`Found::join`]) says of its counts, before they are shifted down.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Found {
    /// Every bit that some pixel has.
    pub bits: u16,
    /// The largest count.
    pub max: u16,
    /// Sum of the absolute differences between neighbours of the same colour in the row.
    pub differences: u64,
}

impl Found {
    pub fn join(&mut self, row: Found) {
        self.bits |= row.bits;
        self.max = self.max.max(row.max);
        self.differences += row.differences;
    }
}

/// Reads a row into `counts` (as long as the row is wide), still justified as they came.
pub(super) fn read(layout: &Layout, bytes: &[u8], counts: &mut [u16]) {
    match layout.container {
        Container::U8 => widen(bytes, counts),
        Container::U16Le => little_endian(bytes, counts),
        Container::U16Be => big_endian(bytes, counts),
        Container::Packed(Packing::Raw10) => unpack_raw10(bytes, counts),
        Container::Packed(Packing::Raw12) => unpack_raw12(bytes, counts),
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn widen(bytes: &[u8], counts: &mut [u16]) {
    for (count, byte) in counts.iter_mut().zip(bytes) {
        *count = u16::from(*byte);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn little_endian(bytes: &[u8], counts: &mut [u16]) {
    for (count, pair) in counts.iter_mut().zip(bytes.as_chunks::<2>().0) {
        *count = u16::from_le_bytes(*pair);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn big_endian(bytes: &[u8], counts: &mut [u16]) {
    for (count, pair) in counts.iter_mut().zip(bytes.as_chunks::<2>().0) {
        *count = u16::from_be_bytes(*pair);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn unpack_raw10(bytes: &[u8], counts: &mut [u16]) {
    let (groups, rest) = counts.as_chunks_mut::<4>();
    let (packed, last) = bytes[..counts_bytes(groups.len(), rest.len(), 5)].as_chunks::<5>();
    debug_assert!(last.is_empty());
    let unpacked = |from: &[u8; 5]| {
        std::array::from_fn::<u16, 4, _>(|i| u16::from(from[i]) << 2 | u16::from(from[4] >> (2 * i) & 3))
    };
    for (group, from) in groups.iter_mut().zip(packed) {
        *group = unpacked(from);
    }
    if let (false, Some(from)) = (rest.is_empty(), packed.last()) {
        let length = rest.len();
        rest.copy_from_slice(&unpacked(from)[..length]);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn unpack_raw12(bytes: &[u8], counts: &mut [u16]) {
    let (groups, rest) = counts.as_chunks_mut::<2>();
    let (packed, last) = bytes[..counts_bytes(groups.len(), rest.len(), 3)].as_chunks::<3>();
    debug_assert!(last.is_empty());
    for (group, from) in groups.iter_mut().zip(packed) {
        group[0] = u16::from(from[0]) << 4 | u16::from(from[2] & 15);
        group[1] = u16::from(from[1]) << 4 | u16::from(from[2] >> 4);
    }
    if let ([count], Some(from)) = (rest, packed.last()) {
        *count = u16::from(from[0]) << 4 | u16::from(from[2] & 15);
    }
}

/// Bytes of so many whole groups and perhaps one begun.
const fn counts_bytes(groups: usize, begun: usize, bytes: usize) -> usize {
    (groups + if begun > 0 { 1 } else { 0 }) * bytes
}

/// Bits, largest and differences; `stride` leads to the next pixel of the same colour.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn measure(counts: &[u16], stride: usize) -> Found {
    let mut found = Found::default();
    for count in counts {
        found.bits |= count;
        found.max = found.max.max(*count);
    }
    // The differences of 4096 pixels fit 32 bits; wrapping, as no check for overflow may stop the vectoriser.
    for (ours, next) in counts.chunks(4096).zip(counts.get(stride..).unwrap_or(&[]).chunks(4096)) {
        let pairs = ours.iter().zip(next);
        let sum = pairs.fold(0u32, |sum, (a, b)| sum.wrapping_add(u32::from(a.abs_diff(*b))));
        found.differences += u64::from(sum);
    }
    found
}

/// Shifts high-justified counts down.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn shift_down(counts: &mut [u16], by: u32) {
    for count in counts {
        *count >>= by & 15;
    }
}

/// The stretches of a row that are looked through at once.
pub(super) const STRETCH: usize = 64;

/// The start of the first stretch from `from` on that holds a pixel which stands more than `above` over both neighbours
/// of its colour. The last stretch is moved back so that it ends a stride before the row does.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn next_suspect(counts: &[u16], stride: usize, above: u16, from: usize) -> Option<usize> {
    let last = counts.len().checked_sub(stride + STRETCH).filter(|last| *last >= stride)?;
    let mut start = from;
    while start < last + STRETCH {
        let here = start.min(last);
        let seen = [here - stride, here, here + stride].map(|at| counts[at..].first_chunk::<STRETCH>());
        let [Some(left), Some(middle), Some(right)] = seen else { return None };
        let mut excess = 0;
        for i in 0..STRETCH {
            excess = excess.max(middle[i].saturating_sub(left[i].max(right[i])));
        }
        if excess > above {
            return Some(here);
        }
        start += STRETCH;
    }
    None
}

/// A fingerprint: rows of which one word differs never have the same one, others have it by chance only.
#[derive(Debug, Clone)]
pub(super) struct Fingerprint {
    lanes: [u32; 64],
}

impl Default for Fingerprint {
    fn default() -> Self {
        Self { lanes: std::array::from_fn(|lane| 0x9e37_79b9 ^ lane as u32) }
    }
}

impl Fingerprint {
    /// Takes in a row. Each lane is a polynomial over its own column of words, which one multiplication a word makes.
    pub fn take(&mut self, bytes: &[u8]) {
        let (blocks, rest) = bytes.as_chunks::<256>();
        fold(&mut self.lanes, blocks);
        if !rest.is_empty() {
            let mut block = [0; 256];
            block[..rest.len()].copy_from_slice(rest);
            fold(&mut self.lanes, &[block]);
        }
    }

    pub fn finish(&self) -> u64 {
        self.lanes.iter().fold(0xcbf2_9ce4_8422_2325, |print, lane| {
            (print ^ u64::from(*lane)).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
        })
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn fold(lanes: &mut [u32; 64], blocks: &[[u8; 256]]) {
    let mut folded = *lanes;
    for block in blocks {
        let (words, _) = block.as_chunks::<4>();
        for i in 0..64 {
            folded[i] = folded[i].wrapping_mul(0x85eb_ca6b).wrapping_add(u32::from_le_bytes(words[i]));
        }
    }
    *lanes = folded;
}
