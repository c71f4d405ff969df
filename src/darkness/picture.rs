//! An 8-bit colour picture, the form in which every method of a comparison sees the same pixels.

use std::path::{Path, PathBuf};

use image::ImageEncoder as _;

/// Rows of red, green, blue bytes.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Picture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height` × `width` × 3.
    pub rgb: Vec<u8>,
}

/// A picture that can't be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct Error {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub reason: image::ImageError,
}

/// A picture that a JPEG can't hold.
#[derive(Debug, thiserror::Error)]
#[error("a picture of {width} × {height} does not go through a JPEG: {reason}")]
pub struct Unpacked {
    width: usize,
    height: usize,
    reason: image::ImageError,
}

impl From<image::RgbImage> for Picture {
    fn from(rgb: image::RgbImage) -> Self {
        Self { width: rgb.width() as usize, height: rgb.height() as usize, rgb: rgb.into_raw() }
    }
}

impl Picture {
    /// Writes it in the format that the name ends with.
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let (width, height) = (self.width as u32, self.height as u32);
        image::save_buffer(path, &self.rgb, width, height, image::ColorType::Rgb8)
            .map_err(|reason| Error { path: path.into(), reason })
    }

    /// What is left of it in a JPEG of this quality (1…100, chroma at full resolution).
    pub fn through_jpeg(&self, quality: u8) -> Result<Self, Unpacked> {
        let mut file = vec![];
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, quality);
        let (width, height) = (self.width as u32, self.height as u32);
        let read = encoder
            .write_image(&self.rgb, width, height, image::ExtendedColorType::Rgb8)
            .and_then(|()| image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg));
        let read = read.map_err(|reason| Unpacked { width: self.width, height: self.height, reason })?;
        Ok(read.into_rgb8().into())
    }

    /// Values 0…1 (255 is 1), interleaved like the bytes, to the nearest byte.
    pub fn from_unit(width: usize, height: usize, values: &[f32]) -> Self {
        let rgb = values.iter().map(|value| (value * 255.0).round().clamp(0.0, 255.0) as u8).collect();
        Self { width, height, rgb }
    }

    /// 3 × `height` × `width` values, each byte times `scale`.
    pub fn planar(&self, scale: f32) -> Vec<f32> {
        (0..3).flat_map(|c| self.rgb.iter().skip(c).step_by(3).map(move |value| f32::from(*value) * scale)).collect()
    }
}
