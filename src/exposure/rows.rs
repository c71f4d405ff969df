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
    // A row is no longer than 65,536 pixels' worth of 16-bit differences in 32 bits only in chunks, hence two sums.
    for (ours, next) in counts.chunks(4096).zip(counts.get(stride..).unwrap_or(&[]).chunks(4096)) {
        let sum: u32 = ours.iter().zip(next).map(|(a, b)| u32::from(a.max(b) - a.min(b))).sum();
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

/// Whether any of the pixels `from..from + STRETCH` stands more than `above` over both neighbours of its colour.
///
/// `left`, `middle` and `right` are the same stretch seen from a stride before, on and after.
#[inline(always)]
fn stands_out(left: &[u16; STRETCH], middle: &[u16; STRETCH], right: &[u16; STRETCH], above: u16) -> bool {
    let mut excess = 0;
    for i in 0..STRETCH {
        excess = excess.max(middle[i].saturating_sub(left[i].max(right[i])));
    }
    excess > above
}

/// The first stretch from number `first` on that may hold a hot pixel; stretches start at `stride` and lie end to end.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn next_suspect(counts: &[u16], stride: usize, above: u16, first: usize) -> Option<usize> {
    let (left, _) = counts.as_chunks::<STRETCH>();
    let (middle, _) = counts.get(stride..)?.as_chunks::<STRETCH>();
    let (right, _) = counts.get(2 * stride..)?.as_chunks::<STRETCH>();
    let count = right.len();
    (first..count).find(|&i| stands_out(&left[i], &middle[i], &right[i], above))
}

/// A fingerprint that differs when any byte of any row does (but for one chance in 2⁶⁴).
#[derive(Debug, Clone)]
pub(super) struct Fingerprint {
    lanes: [u32; 32],
    tail: u64,
}

impl Default for Fingerprint {
    fn default() -> Self {
        Self { lanes: std::array::from_fn(|lane| 0x9e37_79b9 ^ lane as u32), tail: 0xcbf2_9ce4_8422_2325 }
    }
}

impl Fingerprint {
    /// Takes in a row. Each lane is a polynomial over its own column of words, which one multiplication a word makes.
    pub fn take(&mut self, bytes: &[u8]) {
        let (blocks, tail) = bytes.as_chunks::<128>();
        fold(&mut self.lanes, blocks);
        for byte in tail {
            self.tail = (self.tail ^ u64::from(*byte)).wrapping_mul(0x100_0000_01b3);
        }
    }

    pub fn finish(&self) -> u64 {
        self.lanes.iter().fold(self.tail, |print, lane| {
            (print ^ u64::from(*lane)).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
        })
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn fold(lanes: &mut [u32; 32], blocks: &[[u8; 128]]) {
    let mut folded = *lanes;
    for block in blocks {
        let (words, _) = block.as_chunks::<4>();
        for i in 0..32 {
            folded[i] = folded[i].wrapping_mul(0x85eb_ca6b).wrapping_add(u32::from_le_bytes(words[i]));
        }
    }
    *lanes = folded;
}
