//! Our own FlyingChairs: photographs and cut-outs that move as planes, with exact flow and what stays in sight.
//!
//! Every layer is a plane with a picture on it, and moves by a homography, so the flow of a pixel is where its centre
//! goes, without approximation. Flow is that of the layer in front at the pixel of the older frame, also where it
//! leaves the frame or is covered later; beside it stands where the point is still seen. A pair depends on the library,
//! the settings and its number, and on neither threads nor the pairs before it.

mod chairs;
mod drone;
mod library;
mod maps;
mod render;
mod shapes;
pub mod stream;
mod texture;

use std::{fmt, io, path::PathBuf, str::FromStr};

pub use library::Library;

use self::maps::Dice;
use super::{flow_files::Field, recipes::Recipe};

/// The smallest and the largest side of a frame.
const SIDES: std::ops::RangeInclusive<usize> = 32..=4096;

/// How things move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Preset {
    /// As in FlyingChairs: a background and things before it, with its displacements (up to 120 px and more).
    Chairs,
    /// As a drone sees it: a ground plane, things that stand on it, small turns, at most 32 px and mostly less than 8.
    Drone,
    /// Chairs and drone in turn.
    Mixed,
}

/// Which photographs are used, by a hash of their names: the same split on every machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Part {
    /// All.
    #[default]
    All,
    /// Nine of ten.
    Training,
    /// The tenth, for judging.
    HeldOut,
}

/// What is drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// How things move.
    pub preset: Preset,
    /// Columns and rows.
    pub size: [usize; 2],
    /// The same seed gives the same pairs.
    pub seed: u64,
    /// The noise that is added; `None` leaves the frames clean. The scenes are the same under every recipe.
    pub recipe: Option<Recipe>,
}

/// Why there are no scenes.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A folder can't be read.
    #[error("{folder}")]
    Folder {
        /// The folder.
        folder: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A folder without what is needed.
    #[error("{folder}: expected pictures (PNG, JPEG, PPM; cut-outs with transparency), found none among {files} files")]
    NoPictures {
        /// The folder.
        folder: PathBuf,
        /// Files that were looked at.
        files: usize,
    },
    /// A size that can't be drawn.
    #[error("expected columns and rows of 32 to 4096, found {0}×{1}")]
    Size(usize, usize),
    /// A name that nothing has.
    #[error("there is no {what} {found:?}; there are {known}")]
    Name {
        /// Of what.
        what: &'static str,
        /// As given.
        found: String,
        /// What there is.
        known: &'static str,
    },
}

/// A pair with its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Pair {
    /// Its number.
    pub index: u64,
    /// Columns and rows.
    pub size: [usize; 2],
    /// The older frame, RGB of 8 bits, row by row.
    pub older: Vec<u8>,
    /// The newer frame.
    pub newer: Vec<u8>,
    /// Exact flow at the centres of the older frame's pixels, (u right, v down), pixels.
    pub flow: Vec<[f32; 2]>,
    /// Where the older frame's point is still seen in the newer frame: inside it, and not covered.
    pub valid: Vec<bool>,
    /// The noise that was added, if any was.
    pub noise: Option<Grain>,
}

/// The noise of a pair; units of white (1) and of white squared, as the recipe defines them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Grain {
    /// Noise by signal: red, green, blue.
    pub a: [f32; 3],
    /// Noise in the dark: red, green, blue.
    pub b: [f32; 3],
    /// Noise level on the 8-bit scale.
    pub level: f32,
}

/// Draws pairs, any of them, in any order, from any thread.
pub struct Scenes {
    settings: Settings,
    library: Library,
}

impl Scenes {
    /// Checks the settings.
    pub fn new(settings: Settings, library: Library) -> Result<Scenes, Error> {
        if settings.size.iter().any(|side| !SIDES.contains(side)) {
            return Err(Error::Size(settings.size[0], settings.size[1]));
        }
        Ok(Scenes { settings, library })
    }

    /// What is drawn.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The pair of this number.
    pub fn pair(&self, index: u64) -> Pair {
        let mut dice = Dice::new(self.settings.seed, index);
        let size = self.settings.size;
        let chairs = match self.settings.preset {
            Preset::Chairs => true,
            Preset::Drone => false,
            Preset::Mixed => index.is_multiple_of(2),
        };
        let layers = if chairs {
            chairs::layers(&mut dice, &self.library, size)
        } else {
            drone::layers(&mut dice, &self.library, size)
        };
        let mut pair = render::render(index, size, &layers);
        // A recipe refuses only frames that are no pair, and these are one.
        let darkened = |recipe: Recipe| recipe.darken(self.settings.seed, index, &mut pair.older, &mut pair.newer).ok();
        pair.noise = self.settings.recipe.and_then(darkened).map(|drawn| Grain {
            a: drawn.a.map(|a| a as f32),
            b: drawn.b.map(|b| b as f32),
            level: drawn.level as f32,
        });
        pair
    }
}

impl Pair {
    /// The flow as it goes into a file; known everywhere.
    pub fn field(&self) -> Field {
        Field { width: self.size[0], height: self.size[1], vectors: self.flow.clone(), valid: None }
    }
}

impl Part {
    /// The files that belong to it, by their names alone (FNV-1a, modulo ten).
    fn of(self, files: Vec<PathBuf>) -> Vec<PathBuf> {
        let held = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
                (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
            });
            (hash >> 32).is_multiple_of(10)
        };
        let keep = |path: &PathBuf| match self {
            Part::All => true,
            Part::Training => !held(path),
            Part::HeldOut => held(path),
        };
        files.into_iter().filter(keep).collect()
    }
}

impl FromStr for Part {
    type Err = Error;

    fn from_str(name: &str) -> Result<Part, Error> {
        match name {
            "all" => Ok(Part::All),
            "training" => Ok(Part::Training),
            "held-out" => Ok(Part::HeldOut),
            found => Err(Error::Name { what: "part", found: found.into(), known: "all, training and held-out" }),
        }
    }
}

impl FromStr for Preset {
    type Err = Error;

    fn from_str(name: &str) -> Result<Preset, Error> {
        match name {
            "chairs" => Ok(Preset::Chairs),
            "drone" => Ok(Preset::Drone),
            "mixed" => Ok(Preset::Mixed),
            found => Err(Error::Name { what: "preset", found: found.into(), known: "chairs, drone and mixed" }),
        }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Preset::Chairs => "chairs",
            Preset::Drone => "drone",
            Preset::Mixed => "mixed",
        })
    }
}
