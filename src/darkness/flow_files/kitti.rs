//! KITTI flow: a 16-bit RGB PNG of u, v and validity, where u = (red − 2¹⁵) / 64 pixels.

use std::io::Cursor;

use image::{ColorType, DynamicImage, ImageDecoder, ImageEncoder, codecs::png};

use super::{Field, Flaw, frames};

const ZERO: f64 = 32_768.0;
const PER_PIXEL: f64 = 64.0;

/// Reads the bytes of a KITTI flow PNG.
pub fn parse_kitti(bytes: &[u8]) -> Result<Field, Flaw> {
    let refused = |error: image::ImageError| Flaw::Picture(error.to_string());
    frames::png_mark(bytes)?;
    let decoder = png::PngDecoder::with_limits(Cursor::new(bytes), frames::limits()).map_err(refused)?;
    frames::plausible(&decoder, bytes.len(), image::ImageFormat::Png)?;
    let found = decoder.color_type();
    if found != ColorType::Rgb16 {
        return Err(Flaw::Samples { expected: "three channels of 16 bits", found: format!("{found:?}") });
    }
    let pixels = DynamicImage::from_decoder(decoder).map_err(refused)?.into_rgb16();
    let (width, height) = (pixels.width() as usize, pixels.height() as usize);
    let vector = |sample: u16| ((f64::from(sample) - ZERO) / PER_PIXEL) as f32;
    let vectors = pixels.pixels().map(|pixel| {
        let [u, v, valid] = pixel.0;
        (valid != 0).then(|| [vector(u), vector(v)])
    });
    Ok(Field::of(width, height, vectors))
}

/// The field as a KITTI flow PNG, rounded to 1/64 px. A vector that does not fit into ±512 px is refused.
pub fn kitti_bytes(field: &Field) -> Result<Vec<u8>, Flaw> {
    field.check()?;
    let mut samples = Vec::with_capacity(field.vectors.len() * 6);
    for (index, [u, v]) in field.vectors.iter().copied().enumerate() {
        let pixel = if field.known(index) {
            let whole = [u, v].map(|value| (f64::from(value) * PER_PIXEL + ZERO).round());
            if whole.iter().any(|value| !(0.0..=65_535.0).contains(value)) {
                let (column, row) = (index % field.width, index / field.width);
                return Err(Flaw::Vector { u, v, column, row });
            }
            [whole[0] as u16, whole[1] as u16, 1]
        } else {
            [0; 3]
        };
        samples.extend(pixel.iter().flat_map(|sample| sample.to_ne_bytes()));
    }
    let mut bytes = Vec::new();
    png::PngEncoder::new(&mut bytes)
        .write_image(&samples, field.width as u32, field.height as u32, image::ExtendedColorType::Rgb16)
        .map_err(|error| Flaw::Picture(error.to_string()))?;
    Ok(bytes)
}
