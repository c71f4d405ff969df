//! Pairs as a stream of bytes, for a trainer that reads them as fast as they are made.
//!
//! All numbers are little-endian. First a header of [`HEADER`] bytes:
//!
//! | offset | bytes | |
//! | --- | --- | --- |
//! | 0 | 8 | `NFPAIRS` and a zero |
//! | 8 | 4 | version, 1 |
//! | 12 | 4 | bytes of this header |
//! | 16 | 4 | columns |
//! | 20 | 4 | rows |
//! | 24 | 4 | bytes of a flow component: 2 (half) or 4 (single) |
//! | 28 | 4 | bytes of a record |
//! | 32 | 8 | seed |
//! | 40 | 8 | number of the first pair |
//! | 48 | 8 | pairs that follow; 0 is without end |
//! | 56 | 16 | noise recipe, filled up with zeros; `none` for clean pairs |
//! | 72 | 16 | preset, filled up with zeros |
//! | 88 | 8 | zeros |
//!
//! Then record after record, in the order of the pairs' numbers and nothing between them:
//!
//! | bytes | |
//! | --- | --- |
//! | 8 | number of the pair |
//! | 12 | a for red, green, blue (single); 0 for clean pairs |
//! | 12 | b for red, green, blue (single) |
//! | 4 | noise level on the 8-bit scale (single) |
//! | 4 | zeros |
//! | rows · columns · 3 | older frame, RGB |
//! | rows · columns · 3 | newer frame, RGB |
//! | rows · columns · 2 · (2 or 4) | flow, (u right, v down) in pixels, exact everywhere |
//! | rows · columns | 1 where the older frame's point is still seen in the newer, else 0 |

use super::{Pair, Settings};
use crate::darkness::recipes::Recipe;

/// Bytes before the first record.
pub const HEADER: usize = 96;
/// Bytes of a record before its frames.
pub const RECORD_HEAD: usize = 40;
/// What a stream begins with.
pub const MAGIC: &[u8; 8] = b"NFPAIRS\0";
/// Of the layout above.
pub const VERSION: u32 = 1;

/// How flow components are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// 16 bits (IEEE binary16): right to 1/2048 of the component.
    #[default]
    Half,
    /// 32 bits.
    Single,
}

impl Precision {
    /// Bytes of a component.
    pub fn bytes(self) -> usize {
        match self {
            Precision::Half => 2,
            Precision::Single => 4,
        }
    }
}

/// Bytes of a record.
pub fn record_bytes([width, height]: [usize; 2], precision: Precision) -> usize {
    RECORD_HEAD + width * height * (7 + 2 * precision.bytes())
}

/// The stream's first bytes; `pairs` of 0 is without end.
pub fn header(settings: &Settings, precision: Precision, first: u64, pairs: u64) -> [u8; HEADER] {
    let mut bytes = [0; HEADER];
    let mut put = |at: usize, part: &[u8]| bytes[at..at + part.len()].copy_from_slice(part);
    let [width, height] = settings.size;
    put(0, MAGIC);
    let words = [VERSION as usize, HEADER, width, height, precision.bytes(), record_bytes(settings.size, precision)];
    for (place, word) in words.into_iter().enumerate() {
        put(8 + 4 * place, &(word as u32).to_le_bytes());
    }
    for (place, word) in [settings.seed, first, pairs].into_iter().enumerate() {
        put(32 + 8 * place, &word.to_le_bytes());
    }
    let recipe = settings.recipe.map_or("none", Recipe::name);
    for (at, name) in [(56, recipe), (72, &settings.preset.to_string())] {
        put(at, &name.as_bytes()[..name.len().min(16)]);
    }
    bytes
}

/// A pair as a record, behind what `bytes` already holds.
pub fn append(pair: &Pair, precision: Precision, bytes: &mut Vec<u8>) {
    bytes.reserve(record_bytes(pair.size, precision));
    bytes.extend(pair.index.to_le_bytes());
    let noise = pair.noise.unwrap_or_default();
    for value in noise.a.into_iter().chain(noise.b).chain([noise.level, 0.0]) {
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend(&pair.older);
    bytes.extend(&pair.newer);
    let (begin, components) = (bytes.len(), pair.flow.as_flattened());
    bytes.resize(begin + components.len() * precision.bytes(), 0);
    let room = &mut bytes[begin..];
    match precision {
        Precision::Half => {
            room.as_chunks_mut()
                .0
                .iter_mut()
                .zip(components)
                .for_each(|(two, value)| *two = half(*value).to_le_bytes());
        }
        Precision::Single => {
            room.as_chunks_mut().0.iter_mut().zip(components).for_each(|(four, value)| *four = value.to_le_bytes());
        }
    }
    bytes.extend(pair.valid.iter().map(|valid| u8::from(*valid)));
}

/// IEEE binary16, rounded to the nearest, ties to even; what is too large becomes infinite.
fn half(value: f32) -> u16 {
    let bits = value.to_bits();
    let sign = ((bits >> 16) & 0x8000) as u16;
    let magnitude = bits & 0x7fff_ffff;
    if magnitude > 0x7f80_0000 {
        return sign | 0x7e00;
    }
    if magnitude >= 0x4780_0000 {
        return sign | 0x7c00;
    }
    if magnitude < 0x3880_0000 {
        // Below 2⁻¹⁴ halves count in steps of 2⁻²⁴.
        let steps = (f32::from_bits(magnitude) * 16_777_216.0).round_ties_even();
        return sign | steps as u16;
    }
    let rebased = magnitude - 0x3800_0000;
    let rounded = rebased + 0x0fff + (rebased >> 13 & 1);
    sign | (rounded >> 13) as u16
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By the definition, in double precision.
    fn value(half: u16) -> f64 {
        let (sign, power, part) =
            (if half >> 15 == 1 { -1.0 } else { 1.0 }, i32::from(half >> 10 & 31), f64::from(half & 1023));
        match power {
            0 => sign * part * 2_f64.powi(-24),
            31 => sign * f64::INFINITY,
            _ => sign * (1.0 + part / 1024.0) * 2_f64.powi(power - 15),
        }
    }

    #[test]
    fn every_half_is_itself_and_others_become_the_nearest() {
        for bits in (0..0x7c00_u16).chain(0x8000..0xfc00) {
            assert_eq!(half(value(bits) as f32), bits);
        }
        let mut x = 1e-8_f32;
        while x < 60_000.0 {
            let error = (value(half(x)) - f64::from(x)).abs();
            assert!(error <= (f64::from(x) / 2048.0).max(2_f64.powi(-25)), "{x}");
            x *= 1.000_37;
        }
        assert_eq!((half(1e6), half(f32::NEG_INFINITY), half(65_504.0)), (0x7c00, 0xfc00, 0x7bff));
        assert_eq!(half(f32::NAN) & 0x7fff, 0x7e00);
    }
}
