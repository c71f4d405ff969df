//! What an image message says of its bytes, held against the settings and against its own sizes.

use super::{Config, Error, Justification, Packing, Pattern};
use crate::wire::Image;

/// How a pixel stands in its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Container {
    U8,
    U16Le,
    U16Be,
    Packed(Packing),
}

/// How to read a frame whose sizes have been checked: `data` holds `height` rows of `step` bytes, each with room for
/// `width` pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Layout {
    pub width: usize,
    pub height: usize,
    pub step: usize,
    /// Bytes of a row that hold pixels.
    pub row_bytes: usize,
    pub container: Container,
    /// `None` is monochrome.
    pub pattern: Option<Pattern>,
    pub bit_depth: u8,
    pub justification: Justification,
    pub black: f32,
    pub white: f32,
}

impl Layout {
    pub fn read(config: &Config, image: &Image) -> Result<Self, Error> {
        let (container, pattern) = container(config, image)?;
        let bits = match container {
            Container::U8 => 8,
            Container::U16Le | Container::U16Be => 16,
            Container::Packed(packing) => packing.bits(),
        };
        let encoding = || image.encoding.clone();
        let bit_depth = config.bit_depth.unwrap_or(bits);
        if bit_depth > bits || (bit_depth < bits && bits < 16) {
            return Err(Error::Container { bit_depth, encoding: encoding(), container: bits });
        }
        if config.justification == Justification::High && bits == 8 {
            return Err(Error::NoContainer { what: encoding() });
        }
        let limit = (1u32 << bit_depth) - 1;
        let black = config.black_level.unwrap_or(0.0);
        let white = config.white_level.unwrap_or(limit as f32);
        if !(0.0 <= black && black < white && white <= limit as f32) {
            return Err(Error::Levels { black, white, limit });
        }
        let (width, row_bytes) = row(image, container)?;
        let cell = if pattern.is_some() { 2 } else { 1 };
        if width < cell as u64 || (image.height as usize) < cell {
            return Err(Error::Size { cell, encoding: encoding(), width: image.width, height: image.height });
        }
        // Both factors are 32 bits wide, so the product cannot overflow 64.
        let needed = u64::from(image.height) * u64::from(image.step);
        if (image.data.len() as u64) < needed {
            let (height, step) = (image.height, image.step);
            return Err(Error::Short { needed, height, step, found: image.data.len() });
        }
        Ok(Self {
            width: width as usize,
            height: image.height as usize,
            step: image.step as usize,
            row_bytes: row_bytes as usize,
            container,
            pattern,
            bit_depth,
            justification: config.justification,
            black,
            white,
        })
    }

    /// How far a count must be shifted down to stand low.
    pub fn shift(&self) -> u32 {
        match (self.justification, self.container) {
            (Justification::High, Container::U16Le | Container::U16Be) => 16 - u32::from(self.bit_depth),
            _ => 0,
        }
    }

    /// Pixels from one to the next of the same colour.
    pub fn stride(&self) -> usize {
        if self.pattern.is_some() { 2 } else { 1 }
    }

    pub fn row<'a>(&self, bytes: &'a [u8], y: usize) -> &'a [u8] {
        &bytes[y * self.step..][..self.row_bytes]
    }

    /// One count, low-justified. For the few pixels that are looked at one by one.
    pub fn count(&self, bytes: &[u8], x: usize, y: usize) -> u16 {
        let row = self.row(bytes, y);
        let count = match self.container {
            Container::U8 => u16::from(row[x]),
            Container::U16Le => u16::from_le_bytes([row[2 * x], row[2 * x + 1]]),
            Container::U16Be => u16::from_be_bytes([row[2 * x], row[2 * x + 1]]),
            Container::Packed(Packing::Raw10) => {
                let group = &row[x / 4 * 5..][..5];
                u16::from(group[x % 4]) << 2 | u16::from(group[4] >> (2 * (x % 4)) & 3)
            }
            Container::Packed(Packing::Raw12) => {
                let group = &row[x / 2 * 3..][..3];
                u16::from(group[x % 2]) << 4 | u16::from(group[2] >> (4 * (x % 2)) & 15)
            }
        };
        count >> self.shift()
    }
}

/// Reads the encoding, and whether the settings agree with it.
fn container(config: &Config, image: &Image) -> Result<(Container, Option<Pattern>), Error> {
    let encoding = || image.encoding.clone();
    let wide = if image.is_bigendian != 0 { Container::U16Be } else { Container::U16Le };
    // Whether the name leaves the colours open, which only the plain numeric encodings do.
    let (container, named, open) = match image.encoding.as_str() {
        "mono8" => (Container::U8, None, false),
        "mono16" => (wide, None, false),
        "8UC1" => (config.packing.map_or(Container::U8, Container::Packed), None, true),
        "16UC1" => (wide, None, true),
        bayer => {
            let (container, name) = match (bayer.strip_suffix("16"), bayer.strip_suffix('8')) {
                (Some(name), _) => (wide, name),
                (_, Some(name)) => (Container::U8, name),
                _ => return Err(Error::Encoding { found: encoding() }),
            };
            let pattern = match name {
                "bayer_rggb" => Pattern::Rggb,
                "bayer_bggr" => Pattern::Bggr,
                "bayer_gbrg" => Pattern::Gbrg,
                "bayer_grbg" => Pattern::Grbg,
                _ => return Err(Error::Encoding { found: encoding() }),
            };
            (container, Some(pattern), false)
        }
    };
    if let Some(packing) = config.packing.filter(|_| !matches!(container, Container::Packed(_))) {
        return Err(Error::Packing { packing, encoding: encoding() });
    }
    match config.pattern {
        Some(pattern) if !open && named != Some(pattern) => Err(Error::Pattern { encoding: encoding(), pattern }),
        pattern => Ok((container, named.or(pattern))),
    }
}

/// Pixels and bytes of a row, whose step must have room for them.
fn row(image: &Image, container: Container) -> Result<(u64, u64), Error> {
    let (columns, step) = (u64::from(image.width), u64::from(image.step));
    let (width, needed) = match container {
        Container::U8 => (columns, columns),
        Container::U16Le | Container::U16Be => (columns, columns * 2),
        Container::Packed(packing) => {
            // `8UC1` makes some drivers count bytes in `width` and others pixels. As pixels take more than a byte each,
            // a step that has no room for that many of them tells the two apart.
            let [pixels, bytes] = packing.group();
            let taken = columns.div_ceil(pixels) * bytes;
            if taken <= step || columns > step { (columns, taken) } else { (columns / bytes * pixels, columns) }
        }
    };
    if step < needed {
        let (width, step) = (image.width, image.step);
        return Err(Error::Step { width, encoding: image.encoding.clone(), needed, step });
    }
    Ok((width, needed))
}
