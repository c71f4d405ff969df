//! Flow on disk: Middlebury `.flo`, KITTI 16-bit PNG and pictures of flow, and the frames that belong to it.
//!
//! Content from outside is never trusted: sizes are checked against what is there before memory is asked for, and every
//! refusal says what was expected and what was found.

mod flo;
mod frames;
mod kitti;

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
};

use image::{GrayImage, Luma, Rgb, RgbImage};

pub use self::{
    flo::{flo_bytes, parse_flo},
    frames::{parse_frame, read_cutout, read_frame},
    kitti::{kitti_bytes, parse_kitti},
};
use crate::flow::wheel;

/// The longest side that is believed.
const SIDE_MAX: u32 = 65_536;
/// The largest area that is believed: 268 Mpx.
const AREA_MAX: u64 = 1 << 28;

/// Dense flow on the pixels of the older frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Field {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height` × `width`, row by row: (u right, v down) in pixels from the older to the newer frame. Readers set what
    /// is unknown to NaN, so that nobody counts it by mistake.
    pub vectors: Vec<[f32; 2]>,
    /// `height` × `width`: where the flow is known. `None` where all of it is.
    pub valid: Option<Vec<bool>>,
}

/// What is wrong with a file's content.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Flaw {
    /// The file is of another kind.
    #[error("expected {expected} at the beginning, found {found}")]
    Magic {
        /// The mark of the format.
        expected: &'static str,
        /// The first bytes.
        found: String,
    },
    /// A size that no picture has.
    #[error("expected a size of 1×1 to {SIDE_MAX}×{SIDE_MAX} and at most {AREA_MAX} pixels, found {width}×{height}")]
    Size {
        /// Columns, as the file says.
        width: i64,
        /// Rows, as the file says.
        height: i64,
    },
    /// Torn off, or with something behind it.
    #[error("expected {expected} bytes, found {found}")]
    Length {
        /// As the header says.
        expected: u64,
        /// As they are.
        found: u64,
    },
    /// So few bytes cannot hold what the header says, however well they are compressed.
    #[error("expected at least {least} bytes for {width}×{height} pixels, found {found}")]
    Thin {
        /// Columns, as the file says.
        width: u32,
        /// Rows, as the file says.
        height: u32,
        /// The least that can hold them.
        least: u64,
        /// As they are.
        found: u64,
    },
    /// The right kind of file with other samples in it.
    #[error("expected {expected}, found {found}")]
    Samples {
        /// What the format asks for.
        expected: &'static str,
        /// What is there.
        found: String,
    },
    /// A vector that the format has no number for.
    #[error("expected vectors of −512 to 511.98 px, found ({u}, {v}) at column {column}, row {row}")]
    Vector {
        /// To the right.
        u: f32,
        /// Down.
        v: f32,
        /// Where.
        column: usize,
        /// Where.
        row: usize,
    },
    /// A field whose lists don't have its size.
    #[error("expected {expected} {what} for {width}×{height} pixels, found {found}")]
    Count {
        /// Which list.
        what: &'static str,
        /// Width times height.
        expected: usize,
        /// Its length.
        found: usize,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// The picture's own decoder or encoder refuses.
    #[error("expected a readable picture (PNG, JPEG or PNM), found: {0}")]
    Picture(String),
}

/// Why a file can't be read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file system refuses.
    #[error("{path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The content is not what it should be.
    #[error("{path}: {flaw}")]
    Content {
        /// The file.
        path: PathBuf,
        /// Expected against found.
        flaw: Flaw,
    },
    /// The name's ending says nothing about the format.
    #[error("{path}: expected a name that ends in .flo or .png, found {found:?}")]
    Ending {
        /// The file.
        path: PathBuf,
        /// Its ending.
        found: String,
    },
}

impl Error {
    fn io(path: &Path) -> impl FnOnce(io::Error) -> Error {
        let path = path.to_owned();
        move |source| Error::Io { path, source }
    }

    fn content(path: &Path) -> impl FnOnce(Flaw) -> Error {
        let path = path.to_owned();
        move |flaw| Error::Content { path, flaw }
    }

    fn picture(path: &Path) -> impl FnOnce(image::ImageError) -> Error {
        let path = path.to_owned();
        move |error| match error {
            image::ImageError::IoError(source) => Error::Io { path, source },
            other => Error::Content { path, flaw: Flaw::Picture(other.to_string()) },
        }
    }
}

impl Field {
    /// A field that is known everywhere.
    pub fn new(width: usize, height: usize, vectors: Vec<[f32; 2]>) -> Result<Field, Flaw> {
        let field = Field { width, height, vectors, valid: None };
        field.check().map(|()| field)
    }

    /// Whether the vector at this index is known.
    pub fn known(&self, index: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid[index]) && self.vectors[index].iter().all(|v| v.is_finite())
    }

    /// The vector at a pixel, if it is inside and known.
    pub fn at(&self, column: usize, row: usize) -> Option<[f32; 2]> {
        let index = (column < self.width && row < self.height).then_some(row * self.width + column)?;
        self.known(index).then(|| self.vectors[index])
    }

    /// End-point errors against a truth of the same size, pixels, row by row; `None` where the truth is not known, and
    /// infinite where the truth is known and this field is not. `None` in all where the sizes differ.
    pub fn errors(&self, truth: &Field) -> Option<Vec<Option<f32>>> {
        if (self.width, self.height) != (truth.width, truth.height) {
            return None;
        }
        let error = |index: usize| {
            let ([u, v], [tu, tv]) = (self.vectors[index], truth.vectors[index]);
            if self.known(index) { (u - tu).hypot(v - tv) } else { f32::INFINITY }
        };
        Some((0..self.vectors.len()).map(|index| truth.known(index).then(|| error(index))).collect())
    }

    /// The 99th percentile of the known vectors' lengths, at least one pixel: the length that a picture shows at full
    /// colour, so that one wild vector doesn't bleach the rest.
    pub fn longest(&self) -> f32 {
        let known = (0..self.vectors.len()).filter(|index| self.known(*index));
        let mut lengths: Vec<f32> = known.map(|index| self.vectors[index][0].hypot(self.vectors[index][1])).collect();
        if lengths.is_empty() {
            return 1.0;
        }
        let at = (lengths.len() - 1) * 99 / 100;
        lengths.select_nth_unstable_by(at, f32::total_cmp).1.max(1.0)
    }

    /// The flow in colours of the wheel whose rim is `longest` pixels; black where it is not known.
    pub fn picture(&self, longest: f32) -> RgbImage {
        RgbImage::from_fn(self.width as u32, self.height as u32, |x, y| match self.at(x as usize, y as usize) {
            Some([u, v]) => Rgb(wheel::colour(u, v, longest)),
            None => Rgb([0; 3]),
        })
    }

    fn check(&self) -> Result<(), Flaw> {
        let (width, height) = (self.width, self.height);
        checked_size(width as i64, height as i64)?;
        let expected = width * height;
        let lists = [("vectors", Some(self.vectors.len())), ("marks of validity", self.valid.as_ref().map(Vec::len))];
        match lists.into_iter().find(|(_, found)| found.is_some_and(|found| found != expected)) {
            Some((what, found)) => Err(Flaw::Count { what, expected, found: found.unwrap_or(0), width, height }),
            None => Ok(()),
        }
    }

    /// A field out of vectors that are `None` where they are unknown.
    fn of(width: usize, height: usize, vectors: impl Iterator<Item = Option<[f32; 2]>>) -> Field {
        let mut field = Field { width, height, vectors: Vec::with_capacity(width * height), valid: None };
        let mut valid = Vec::with_capacity(width * height);
        for vector in vectors {
            field.vectors.push(vector.unwrap_or([f32::NAN; 2]));
            valid.push(vector.is_some());
        }
        field.valid = valid.contains(&false).then_some(valid);
        field
    }
}

/// Reads `.flo` or a KITTI PNG, by the name's ending.
pub fn read(path: &Path) -> Result<Field, Error> {
    match ending(path).as_str() {
        "flo" => {
            let file = File::open(path).map_err(Error::io(path))?;
            flo::read_flo(file).map_err(Error::io(path))?.map_err(Error::content(path))
        }
        "png" => {
            let bytes = std::fs::read(path).map_err(Error::io(path))?;
            parse_kitti(&bytes).map_err(Error::content(path))
        }
        found => Err(Error::Ending { path: path.into(), found: found.into() }),
    }
}

/// Writes `.flo` or a KITTI PNG, by the name's ending.
pub fn write(path: &Path, field: &Field) -> Result<(), Error> {
    let bytes = match ending(path).as_str() {
        "flo" => flo_bytes(field),
        "png" => kitti_bytes(field),
        found => return Err(Error::Ending { path: path.into(), found: found.into() }),
    };
    std::fs::write(path, bytes.map_err(Error::content(path))?).map_err(Error::io(path))
}

/// Writes the flow as a picture in the colours of the wheel; the rim is `longest` pixels.
pub fn write_picture(path: &Path, field: &Field, longest: f32) -> Result<(), Error> {
    field.check().map_err(Error::content(path))?;
    field.picture(longest).save(path).map_err(Error::picture(path))
}

/// Writes where the flow is known as a grey picture: white there, black elsewhere.
pub fn write_mask(path: &Path, field: &Field) -> Result<(), Error> {
    field.check().map_err(Error::content(path))?;
    let mask = GrayImage::from_fn(field.width as u32, field.height as u32, |x, y| {
        let known = field.known(y as usize * field.width + x as usize);
        Luma([if known { 255 } else { 0 }])
    });
    mask.save(path).map_err(Error::picture(path))
}

fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_lowercase()
}

/// A size that may be believed before any memory is asked for.
fn checked_size(width: i64, height: i64) -> Result<(usize, usize), Flaw> {
    let side = 1..=i64::from(SIDE_MAX);
    if !side.contains(&width) || !side.contains(&height) || (width * height).unsigned_abs() > AREA_MAX {
        return Err(Flaw::Size { width, height });
    }
    Ok((width as usize, height as usize))
}
