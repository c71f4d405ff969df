//! Frames as pictures: PNG, JPEG and PNM (`.ppm`), read with their size checked against the bytes that are there.

use std::{io::Cursor, path::Path};

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits, RgbImage, RgbaImage};

use super::{Error, Flaw, SIDE_MAX, checked_size};

/// What decoders may allocate: the largest believed picture with three channels of 16 bits.
const BYTES_MAX: u64 = 6 * super::AREA_MAX;
const PNG_MARK: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Reads a PNG, JPEG or PNM picture as 8-bit RGB; 16-bit samples are rounded, transparency is dropped.
pub fn read_frame(path: &Path) -> Result<RgbImage, Error> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    parse_frame(&bytes).map_err(Error::content(path))
}

/// Reads a picture with its transparency, 8 bits a channel; without any it is opaque.
pub fn read_cutout(path: &Path) -> Result<RgbaImage, Error> {
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    Ok(parse_any(&bytes).map_err(Error::content(path))?.into_rgba8())
}

/// [`read_frame`] from bytes in memory.
pub fn parse_frame(bytes: &[u8]) -> Result<RgbImage, Flaw> {
    Ok(parse_any(bytes)?.into_rgb8())
}

/// A picture with whatever channels it has.
fn parse_any(bytes: &[u8]) -> Result<DynamicImage, Flaw> {
    let refused = |error: image::ImageError| Flaw::Picture(error.to_string());
    let mut reader =
        ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|error| Flaw::Picture(error.to_string()))?;
    reader.limits(limits());
    let format = reader.format().ok_or_else(|| Flaw::Magic {
        expected: "the mark of a PNG, JPEG or PNM picture",
        found: format!("{:?}", String::from_utf8_lossy(&bytes[..bytes.len().min(4)])),
    })?;
    let decoder = reader.into_decoder().map_err(refused)?;
    plausible(&decoder, bytes.len(), format)?;
    DynamicImage::from_decoder(decoder).map_err(refused)
}

pub(super) fn limits() -> Limits {
    let mut limits = Limits::default();
    limits.max_image_width = Some(SIDE_MAX);
    limits.max_image_height = Some(SIDE_MAX);
    limits.max_alloc = Some(BYTES_MAX);
    limits
}

pub(super) fn png_mark(bytes: &[u8]) -> Result<(), Flaw> {
    if bytes.starts_with(PNG_MARK) {
        return Ok(());
    }
    let found = format!("{:?}", String::from_utf8_lossy(&bytes[..bytes.len().min(8)]));
    Err(Flaw::Magic { expected: "\"\\x89PNG\"", found })
}

/// Refuses a header that promises more pixels than so few bytes can hold.
pub(super) fn plausible(decoder: &impl ImageDecoder, found: usize, format: ImageFormat) -> Result<(), Flaw> {
    let (width, height) = decoder.dimensions();
    checked_size(width.into(), height.into())?;
    let most = match format {
        // Deflate makes at most 1032 bytes of one.
        ImageFormat::Png => 1032,
        // A bitmap makes eight bytes of one.
        ImageFormat::Pnm => 8,
        // Two bits a block of 64 samples, at the coarsest colour sampling.
        _ => 4096,
    };
    let least = decoder.total_bytes().div_ceil(most);
    let found = found as u64;
    if found < least { Err(Flaw::Thin { width, height, least, found }) } else { Ok(()) }
}
