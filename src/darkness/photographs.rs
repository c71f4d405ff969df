//! Raw photographs as the sensor counted them; the one place that knows the crate which decodes camera files.

use std::path::Path;

/// The active area of a raw photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct RawPhotograph {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Raw counts, `height` × `width`.
    pub counts: Vec<u16>,
    /// Counts without light, at the four places of a cell: the first row's two, then the second's.
    pub black: [f32; 4],
    /// Counts of a full pixel.
    pub white: f32,
    /// Side of the filter's pattern: 2 (Bayer) or 6 (X-Trans).
    pub period: usize,
    /// `period` × `period` from the first pixel on: 0 red, 1 green, 2 blue.
    pub colours: Vec<u8>,
    /// As in `Canon EOS 30D`.
    pub camera: String,
    /// Sensitivity, where the file tells it.
    pub iso: Option<u32>,
}

/// Why there is no photograph.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Built without the reader.
    #[error(
        "{0} is a camera raw file, and this build can't read those: rebuild with `cargo build --release --features raw` \
         (rawler, which reads them, is LGPL-2.1)"
    )]
    Feature(String),
    /// The reader refuses.
    #[error("{path}: {reason}")]
    Unreadable {
        /// The file.
        path: String,
        /// Its words.
        reason: String,
    },
}

/// Whether a name ends as raw files do.
pub fn is_raw(name: &str) -> bool {
    let ending = Path::new(name).extension().map(|ending| ending.to_string_lossy().to_lowercase());
    ending.is_some_and(|ending| ["cr2", "cr3", "arw", "raf", "dng", "nef"].contains(&ending.as_str()))
}

/// Reads a camera's raw file (CR2, DNG, ARW, RAF and whatever else rawler reads).
#[cfg(not(feature = "raw"))]
pub fn read(path: &Path) -> Result<RawPhotograph, Error> {
    Err(Error::Feature(path.display().to_string()))
}

/// Reads a camera's raw file (CR2, DNG, ARW, RAF and whatever else rawler reads).
#[cfg(feature = "raw")]
pub fn read(path: &Path) -> Result<RawPhotograph, Error> {
    use rawler::{
        decoders::RawDecodeParams,
        rawimage::{RawImageData, RawPhotometricInterpretation::Cfa},
        rawsource::RawSource,
    };
    let wrong = |reason: String| Error::Unreadable { path: path.display().to_string(), reason };
    let source = RawSource::new(path).map_err(|error| wrong(error.to_string()))?;
    let params = RawDecodeParams::default();
    let decoder = rawler::get_decoder(&source).map_err(|error| wrong(error.to_string()))?;
    let raw = decoder.raw_image(&source, &params, false).map_err(|error| wrong(error.to_string()))?;
    let exif = decoder.raw_metadata(&source, &params).map(|known| known.exif).ok();
    // Some writers leave a 0 where they know none.
    let iso = exif.and_then(|exif| exif.iso_speed.or(exif.iso_speed_ratings.map(u32::from))).filter(|iso| *iso > 0);
    let (RawImageData::Integer(all), Cfa(mosaic)) = (&raw.data, &raw.photometric) else {
        return Err(wrong("expected integer counts of a colour filter".into()));
    };
    let (left, top, width, height) = match raw.active_area {
        Some(area) => (area.p.x, area.p.y, area.d.w, area.d.h),
        None => (0, 0, raw.width, raw.height),
    };
    let period = if mosaic.cfa.width.is_multiple_of(3) { 6 } else { 2 };
    let colour = |i: usize| mosaic.cfa.color_at(top + i / period, left + i % period) as u8;
    let counts = (top..top + height).flat_map(|row| all[row * raw.width + left..][..width].iter().copied()).collect();
    // rawler gives levels from the sensor's own corner, which the active area need not share.
    let levels = raw.blacklevel.as_vec();
    let black = match levels.len() {
        4 => raw.blacklevel.shift(left, top).as_bayer_array(),
        many => [levels.iter().sum::<f32>() / many.max(1) as f32; 4],
    };
    Ok(RawPhotograph {
        width,
        height,
        counts,
        black,
        white: raw.whitelevel.as_bayer_array()[0],
        period,
        colours: (0..period * period).map(colour).collect(),
        camera: format!("{} {}", raw.clean_make, raw.clean_model),
        iso,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_files_are_known_by_their_ending() {
        assert!(is_raw("01020304_img1.RAF") && is_raw("a.cr2") && !is_raw("01020304_img1.png") && !is_raw("raf"));
    }
}
