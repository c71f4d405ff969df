//! Why a frame can't be developed, or why no frame ever could.

use super::{Packing, Pattern};

/// Every variant but the settings' own spoils one frame; the frames kept before it stay.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[allow(missing_docs)]
pub enum Error {
    /// A setting is out of its range.
    #[error("exposure.{key}: expected {low} to {high}, found {value}")]
    Settings { key: &'static str, low: f32, high: f32, value: f32 },
    /// No sensor has this depth.
    #[error("exposure.bit_depth: expected 8, 10, 12, 14 or 16, found {bit_depth}")]
    BitDepth { bit_depth: u8 },
    /// Packing says one depth, the setting another.
    #[error("exposure.packing = \"{packing}\" has {bits} bits a pixel, but exposure.bit_depth = {bit_depth} is set")]
    PackedDepth { packing: Packing, bits: u8, bit_depth: u8 },
    /// Justification without spare bits.
    #[error(
        "exposure.justification = \"high\" is for 16-bit containers, but {what} has no spare bits: set it to \"low\""
    )]
    NoContainer { what: String },
    /// An encoding that is no raw image.
    #[error(
        "encoding: expected bayer_{{rggb,bggr,gbrg,grbg}}{{8,16}}, mono8, mono16, 16UC1 or 8UC1, found \"{found}\""
    )]
    Encoding { found: String },
    /// The message and the setting name different mosaics.
    #[error("the image says {encoding}, but exposure.pattern = \"{pattern}\" is set: one of them is wrong")]
    Pattern { encoding: String, pattern: Pattern },
    /// Packed bytes come as `8UC1` only.
    #[error("exposure.packing = \"{packing}\" needs the encoding 8UC1, found {encoding}")]
    Packing { packing: Packing, encoding: String },
    /// More bits than the encoding has.
    #[error("exposure.bit_depth = {bit_depth} is set, but {encoding} holds {container} bits a pixel")]
    Container { bit_depth: u8, encoding: String, container: u8 },
    /// Black and white leave no range.
    #[error("expected 0 <= black level < white level <= {limit}, found black {black} and white {white}")]
    Levels { black: f32, white: f32, limit: u32 },
    /// No whole cell.
    #[error("size: expected at least {cell}x{cell} pixels for {encoding}, found {width}x{height}")]
    Size { cell: usize, encoding: String, width: u32, height: u32 },
    /// Rows overlap.
    #[error("step: a row of {width} pixels as {encoding} takes {needed} bytes, found a step of {step}")]
    Step { width: u32, encoding: String, needed: u64, step: u32 },
    /// The message is cut, or its sizes are made up.
    #[error("data: expected {needed} bytes for {height} rows of {step}, found {found}")]
    Short { needed: u64, height: u32, step: u32, found: usize },
    /// Counts that the declared depth can't hold.
    #[error(
        "bit_depth {bit_depth} with justification \"low\" allows counts up to {limit}, but the frame holds \
         {max}: the depth is larger, or the justification is \"high\""
    )]
    AboveDepth { bit_depth: u8, limit: u32, max: u32 },
    /// Low bits are set although the counts should stand high.
    #[error(
        "bit_depth {bit_depth} with justification \"high\" leaves the low {spare} bits zero, but the frame sets bits \
         {seen:#x} there: the depth is larger, or the justification is \"low\""
    )]
    LowBitsSet { bit_depth: u8, spare: u32, seen: u32 },
    /// Low bits are never set although the counts should stand low.
    #[error(
        "bit_depth {bit_depth} with justification \"low\" is declared, but the low {zeros} bits of all {pixels} \
         non-zero pixels are zero: it looks like bit_depth = {likely} with justification = \"high\""
    )]
    LowBitsZero { bit_depth: u8, zeros: u32, pixels: u64, likely: u32 },
    /// Counts far above white.
    #[error("white level {white} is declared, but the frame holds counts of {max}: white level or bit_depth is wrong")]
    AboveWhite { white: f32, max: u32 },
    /// Less than no light.
    #[error("black level {black} is declared, but the frame's mean is {mean:.1}: the black level is too high")]
    BlackAboveMean { black: f32, mean: f32 },
}
