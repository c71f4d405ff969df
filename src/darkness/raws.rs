//! Raw pairs as the benchmark's authors scale them: cells binned to colours, black off, mean 0.4, reduced to the truth's size.
//!
//! A Bayer mosaic is binned 2 × 2 (its two greens averaged), an X-Trans mosaic 3 × 3, which holds two reds, two blues
//! and five greens wherever it is cut on the pattern's grid of three. Both frames get one gain.

use std::path::Path;

use super::{
    ladder::SCALED,
    photographs::{self, RawPhotograph},
    picture::Picture,
};

/// A raw photograph with whatever colour filter.
#[derive(Debug, Clone, PartialEq)]
pub struct Mosaic {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Raw counts.
    pub counts: Vec<u16>,
    /// Counts without light.
    pub black: f64,
    /// Counts of a full pixel.
    pub white: f64,
    /// Side of the filter's pattern: 2 (Bayer) or 6 (X-Trans).
    pub period: usize,
    /// `period` × `period`: 0 red, 1 green, 2 blue.
    pub colours: Vec<u8>,
}

/// Why raws make no pair.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No photograph.
    #[error(transparent)]
    File(#[from] photographs::Error),
    /// A cell of the pattern lacks a colour, or there is no whole cell.
    #[error("expected a mosaic of whole Bayer or X-Trans cells, found {width}×{height} with a pattern of {period}")]
    Pattern {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Side of the pattern.
        period: usize,
    },
    /// Two frames that don't belong together.
    #[error("the frames are of {0:?} and {1:?} pixels")]
    Sizes((usize, usize), (usize, usize)),
    /// Larger than its picture.
    #[error("the raw has {from:?} cells, the truth {to:?} pixels; expected the truth to be the smaller one")]
    Small {
        /// Binned columns and rows.
        from: (usize, usize),
        /// The truth's.
        to: (usize, usize),
    },
}

/// Black levels that VBOF's authors took off, by the maker's name; the rest of the world has its file's own.
pub const BLACKS: [(&str, f64); 4] = [("sony", 512.0), ("canon", 2047.0), ("fujifilm", 1022.0), ("nikon", 100.0)];

/// A picture of linear colours, `height` × `width` × 3, black off, white 1, not clipped.
#[derive(Debug, Clone, PartialEq)]
pub struct Binned {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The values.
    pub rgb: Vec<f32>,
}

impl Mosaic {
    /// Side of a cell that holds every colour.
    fn side(&self) -> usize {
        if self.period.is_multiple_of(3) { 3 } else { 2 }
    }

    /// Columns and rows of a picture of its shape with at most so many columns, and no more than there are cells.
    pub fn size_of(&self, columns: usize) -> (usize, usize) {
        let (width, height) = (self.width / self.side(), self.height / self.side());
        let columns = columns.min(width);
        (columns, (height * columns + width / 2) / width.max(1))
    }

    /// Means of each colour in each cell, 2 × 2 or 3 × 3.
    pub fn binned(&self) -> Result<Binned, Error> {
        let side = self.side();
        let (width, height) = (self.width / side, self.height / side);
        let colour = |x: usize, y: usize| usize::from(self.colours[y % self.period * self.period + x % self.period]);
        let complete = |cell: (usize, usize)| {
            let found = (0..side * side).map(|i| colour(cell.0 + i % side, cell.1 + i / side));
            found.fold(0, |seen, colour| seen | 1 << colour) == 7
        };
        let wrong = || Error::Pattern { width: self.width, height: self.height, period: self.period };
        let cells = (0..self.period).step_by(side).flat_map(|y| (0..self.period).step_by(side).map(move |x| (x, y)));
        if width * height == 0 || self.colours.len() != self.period * self.period || !cells.clone().all(complete) {
            return Err(wrong());
        }
        let scale = 1.0 / (self.white - self.black);
        let mut rgb = Vec::with_capacity(3 * width * height);
        for y in 0..height {
            for x in 0..width {
                let (mut sums, mut counts) = ([0.0; 3], [0.0; 3]);
                for i in 0..side * side {
                    let (x, y) = (x * side + i % side, y * side + i / side);
                    sums[colour(x, y)] += f64::from(self.counts[y * self.width + x]) - self.black;
                    counts[colour(x, y)] += 1.0;
                }
                rgb.extend((0..3).map(|c| (sums[c] / counts[c] * scale) as f32));
            }
        }
        Ok(Binned { width, height, rgb })
    }
}

impl Binned {
    /// Reduced by averaging areas; a pixel of the result is the mean of what it covers.
    pub fn reduced(&self, width: usize, height: usize) -> Binned {
        let columns = covers(self.width, width);
        let mut lines = vec![0.0f32; self.height * width * 3];
        for (into, from) in lines.chunks_exact_mut(width * 3).zip(self.rgb.chunks_exact(self.width * 3)) {
            for (pixel, cover) in into.chunks_exact_mut(3).zip(&columns) {
                for &(at, part) in cover {
                    (0..3).for_each(|c| pixel[c] += part * from[3 * at + c]);
                }
            }
        }
        let mut rgb = vec![0.0f32; height * width * 3];
        for (into, cover) in rgb.chunks_exact_mut(width * 3).zip(covers(self.height, height)) {
            for (at, part) in cover {
                into.iter_mut().zip(&lines[at * width * 3..]).for_each(|(sum, value)| *sum += part * value);
            }
        }
        Binned { width, height, rgb }
    }
}

/// Which of `from` points each of `to` covers, with the part of it.
fn covers(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let ratio = from as f64 / to as f64;
    let cover = |i: usize| {
        let (begin, end) = (i as f64 * ratio, (i + 1) as f64 * ratio);
        let points = begin as usize..(end.ceil() as usize).min(from);
        points.map(move |at| (at, ((end.min(at as f64 + 1.0) - begin.max(at as f64)) / ratio) as f32)).collect()
    };
    (0..to).map(cover).collect()
}

/// Two raws as a pair of pictures of this size (columns, rows): the same gain, mean [`SCALED`], clipped, 8 bits.
pub fn scaled(mosaics: [&Mosaic; 2], (width, height): (usize, usize)) -> Result<[Picture; 2], Error> {
    let [first, second] = [mosaics[0].binned()?, mosaics[1].binned()?];
    if (first.width, first.height) != (second.width, second.height) {
        return Err(Error::Sizes((first.width, first.height), (second.width, second.height)));
    }
    if first.width < width || first.height < height || width * height == 0 {
        return Err(Error::Small { from: (first.width, first.height), to: (width, height) });
    }
    let frames = [first.reduced(width, height), second.reduced(width, height)];
    let sum: f64 = frames.iter().flat_map(|frame| &frame.rgb).map(|value| f64::from(*value)).sum();
    let mean = sum / (6 * width * height) as f64;
    let gain = (SCALED / mean.max(1e-6)) as f32;
    Ok(frames.map(|frame| {
        let values: Vec<f32> = frame.rgb.iter().map(|value| value * gain).collect();
        Picture::from_unit(width, height, &values)
    }))
}

/// Columns that raws are reduced to where no truth says how many: the benchmark's.
pub const COLUMNS: usize = 736;

/// Reads two raw files and scales them as [`scaled`] does, without a size to one of [`COLUMNS`] with the same shape.
pub fn pair(paths: [&Path; 2], size: Option<(usize, usize)>) -> Result<[Picture; 2], Error> {
    let [first, second] = [mosaic(paths[0])?, mosaic(paths[1])?];
    let size = size.unwrap_or_else(|| first.size_of(COLUMNS));
    scaled([&first, &second], size)
}

/// A photograph with the black level that the authors took off.
fn mosaic(path: &Path) -> Result<Mosaic, Error> {
    let RawPhotograph { width, height, counts, black, white, period, colours, camera, .. } = photographs::read(path)?;
    let maker = camera.to_lowercase();
    let authors = BLACKS.iter().find(|(name, _)| maker.starts_with(name)).map(|(_, black)| *black);
    // The authors' level is that of 14-bit files; a file of another depth has its own.
    let own = f64::from(black.iter().sum::<f32>() / 4.0);
    let black = authors.filter(|_| white > 8192.0).unwrap_or(own);
    Ok(Mosaic { width, height, counts, black, white: f64::from(white), period, colours })
}
