//! The dark data set on disk: pairs in FlyingChairs' layout in, the same names in the dark out.
//!
//! A pair is `NAME_img1.ppm`, `NAME_img2.ppm` and `NAME_flow.flo`; frames may be PNG or JPEG as well, and are always
//! written as PPM. Beside the pairs lie `fcdn.toml`, which says how they were made, and `fcdn.csv`, which says what was
//! drawn for each. A pair counts as finished once its row is written, and its row comes after its files, so that
//! whatever a kill leaves behind is made again, to the same bytes.

mod frames;
mod rows;

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::xxh3_64;

use super::{
    flow_files,
    recipes::{self, Drawn, Recipe},
};
use frames::Frame;
pub use rows::{Rows, TITLE, row};

/// How the set was made.
const MANIFEST: &str = "fcdn.toml";
/// Goes up when the same recipe and seed no longer give the same bytes.
const VERSION: u32 = 1;
/// What a file is called until all of it is there.
const PART: &str = "part";
const HEADER_OF_FLOW: u64 = 12;

/// A pair by its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pair {
    /// As in `00042`.
    pub name: String,
    /// What its noise is drawn from: the name as a number, or a number made of the name. Other pairs that come or go
    /// don't change it.
    pub number: u64,
    /// Older and newer frame.
    pub frames: [PathBuf; 2],
    /// Middlebury's `.flo`.
    pub flow: PathBuf,
}

/// Why a pair, or a whole set, isn't made.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file of a pair isn't there.
    #[error("pair {name} has no {name}_{part}")]
    Missing {
        /// The pair.
        name: String,
        /// As in `img2.ppm`.
        part: &'static str,
    },
    /// A frame that can't be read.
    #[error(transparent)]
    Frame(#[from] flow_files::Error),
    /// Frames of different size.
    #[error("pair {name}: the frames have {older} and {newer} pixels, expected equal sizes", older = by(older), newer = by(newer))]
    Sizes {
        /// The pair.
        name: String,
        /// Columns and rows.
        older: [usize; 2],
        /// Columns and rows.
        newer: [usize; 2],
    },
    /// A flow that is torn or not the frames'.
    #[error("{path}: expected the flow of {size} pixels in {expected} bytes, found {found}", size = by(size))]
    Flow {
        /// The file.
        path: PathBuf,
        /// Columns and rows of the frames.
        size: [usize; 2],
        /// Bytes that their flow takes.
        expected: u64,
        /// What the header or the length says instead.
        found: String,
    },
    /// The recipe refuses.
    #[error(transparent)]
    Recipe(#[from] recipes::Error),
    /// Nothing can be read from or written to a folder.
    #[error("{path}")]
    Folder {
        /// File or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The folder holds a set that was made otherwise.
    #[error(
        "{path} says that the set there is made by {was}, and {asked} is asked for: name another folder, or ask for the same"
    )]
    Other {
        /// The manifest.
        path: PathBuf,
        /// As it is.
        was: String,
        /// As it would become.
        asked: String,
    },
    /// Not a pair in the folder.
    #[error(
        "{path} holds no pair: expected NAME_img1.ppm, NAME_img2.ppm (or .png, .jpg) and NAME_flow.flo, as FlyingChairs has them"
    )]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// Pairs, but none that can be used.
    #[error("none of the {pairs} pairs of {path} could be made")]
    Unusable {
        /// The folder.
        path: PathBuf,
        /// Pairs that were tried.
        pairs: usize,
    },
    /// The folder holds pairs of unknown origin.
    #[error("{path} holds {example} but no fcdn.toml, and would be overwritten: name an empty folder")]
    Occupied {
        /// The folder.
        path: PathBuf,
        /// One of the files.
        example: String,
    },
}

fn by([width, height]: &[usize; 2]) -> String {
    format!("{width}×{height}")
}

impl Error {
    /// Whether the next pair would meet the same.
    pub fn fatal(&self) -> bool {
        matches!(self, Error::Folder { .. }) || self.mistaken()
    }

    /// Whether something else should have been asked for.
    pub fn mistaken(&self) -> bool {
        matches!(self, Error::Other { .. } | Error::Empty { .. } | Error::Unusable { .. } | Error::Occupied { .. })
    }

    fn folder(path: &Path) -> impl FnOnce(io::Error) -> Error {
        let path = path.to_owned();
        move |source| Error::Folder { path, source }
    }
}

/// The pairs of a folder in the order of their names; an error for each that lacks a file.
pub fn pairs(from: &Path) -> Result<Vec<Result<Pair, Error>>, Error> {
    let mut found: BTreeMap<String, [Option<PathBuf>; 3]> = BTreeMap::new();
    for entry in fs::read_dir(from).map_err(Error::folder(from))? {
        let path = entry.map_err(Error::folder(from))?.path();
        let Some((name, part)) = path.file_name().and_then(|file| file.to_str()).and_then(part_of) else { continue };
        let place = &mut found.entry(name.to_owned()).or_default()[part];
        // Of two kinds of the same frame the PPM, which is the original's.
        if place.is_none() || path.extension().is_some_and(|ending| ending == "ppm") {
            *place = Some(path);
        }
    }
    Ok(found.into_iter().map(|(name, parts)| pair(name, parts)).collect())
}

/// Name and part of a file: 0 older frame, 1 newer frame, 2 flow.
fn part_of(file: &str) -> Option<(&str, usize)> {
    let (stem, ending) = file.rsplit_once('.')?;
    let picture = ["ppm", "png", "jpg", "jpeg"].contains(&ending);
    let part = |end: &str, wanted: bool| stem.strip_suffix(end).filter(|name| wanted && !name.is_empty());
    let parts = [("_img1", picture), ("_img2", picture), ("_flow", ending == "flo")];
    parts.into_iter().enumerate().find_map(|(number, (end, wanted))| Some((part(end, wanted)?, number)))
}

fn pair(name: String, [older, newer, flow]: [Option<PathBuf>; 3]) -> Result<Pair, Error> {
    let there = |path: Option<PathBuf>, part| path.ok_or(Error::Missing { name: name.clone(), part });
    let frames = [there(older, "img1.ppm (nor .png, .jpg)")?, there(newer, "img2.ppm (nor .png, .jpg)")?];
    let flow = there(flow, "flow.flo")?;
    let number = name.parse().unwrap_or_else(|_| xxh3_64(name.as_bytes()));
    Ok(Pair { name, number, frames, flow })
}

/// The manifest's content.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Manifest {
    recipe: String,
    seed: u64,
    version: u32,
}

impl Manifest {
    fn told(&self) -> String {
        format!("recipe {}, seed {}, version {}", self.recipe, self.seed, self.version)
    }
}

/// A set in the making.
#[derive(Debug, Clone)]
pub struct Set {
    to: PathBuf,
    recipe: Recipe,
    seed: u64,
}

/// Bytes of a pair's frames, kept from pair to pair.
#[derive(Default)]
struct Memory {
    frames: [Vec<u8>; 2],
}

impl Set {
    /// Opens a folder for a set, makes it where it isn't, and refuses one that was made otherwise. A seed is at most
    /// 2⁶³ − 1, which is what the manifest can hold.
    pub fn open(to: &Path, recipe: Recipe, seed: u64) -> Result<Self, Error> {
        let asked = Manifest { recipe: recipe.name().into(), seed, version: VERSION };
        fs::create_dir_all(to).map_err(Error::folder(to))?;
        let path = to.join(MANIFEST);
        match fs::read_to_string(&path) {
            Ok(text) => {
                let was: Option<Manifest> = toml::from_str(&text).ok();
                if was.as_ref() != Some(&asked) {
                    let was = was.map_or_else(|| format!("{text:?}"), |was| was.told());
                    return Err(Error::Other { path, was, asked: asked.told() });
                }
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let taken = pairs(to)?.into_iter().next().map(|pair| match pair {
                    Ok(Pair { name, .. }) | Err(Error::Missing { name, .. }) => format!("the pair {name}"),
                    Err(error) => error.to_string(),
                });
                if let Some(example) = taken {
                    return Err(Error::Occupied { path: to.into(), example });
                }
                let text = toml::to_string(&asked).map_err(|error| Error::folder(&path)(io::Error::other(error)))?;
                let text =
                    format!("# Made by `nightflow synth fcdn`; what was drawn for each pair is in fcdn.csv.\n{text}");
                whole(&path, |part| fs::write(part, text))?;
            }
            Err(error) => return Err(Error::folder(&path)(error)),
        }
        Ok(Self { to: to.into(), recipe, seed })
    }

    /// Makes pairs on all threads of the current rayon pool, and tells of each as it is finished, in any order. What
    /// would stop every other pair as well ends the work and is returned.
    pub fn make_all(
        &self,
        pairs: &[Pair],
        told: &(impl Fn(&Pair, Result<Drawn, Error>) -> Result<(), Error> + Sync),
    ) -> Result<(), Error> {
        pairs.par_iter().try_for_each_init(Memory::default, |memory, pair| match self.make(pair, memory) {
            Err(error) if error.fatal() => Err(error),
            made => told(pair, made),
        })
    }

    /// Reads a pair, darkens it and writes it: frames first, the flow last.
    fn make(&self, pair: &Pair, memory: &mut Memory) -> Result<Drawn, Error> {
        let [older, newer] = &mut memory.frames;
        let mut older = Frame::read(&pair.frames[0], older)?;
        let mut newer = Frame::read(&pair.frames[1], newer)?;
        if older.size != newer.size {
            return Err(Error::Sizes { name: pair.name.clone(), older: older.size, newer: newer.size });
        }
        check_flow(&pair.flow, older.size)?;
        let drawn = self.recipe.darken(self.seed, pair.number, older.pixels(), newer.pixels())?;
        let [first, second, flow] = self.files(&pair.name);
        whole(&first, |part| fs::write(part, older.bytes()))?;
        whole(&second, |part| fs::write(part, newer.bytes()))?;
        whole(&flow, |part| copy(&pair.flow, part))?;
        Ok(drawn)
    }

    /// Where a pair's files go.
    fn files(&self, name: &str) -> [PathBuf; 3] {
        ["img1.ppm", "img2.ppm", "flow.flo"].map(|part| self.to.join(format!("{name}_{part}")))
    }

    /// Whether all files of a pair are there and as long as they should be.
    pub fn holds(&self, pair: &Pair) -> bool {
        let length = |path: &Path| fs::metadata(path).map_or(0, |known| known.len());
        let [first, second, flow] = self.files(&pair.name).map(|path| length(&path));
        let pixels = flow.saturating_sub(HEADER_OF_FLOW) / 8;
        flow > HEADER_OF_FLOW && flow == length(&pair.flow) && first == second && first > 3 * pixels
    }

    /// The rows that the set's folder holds.
    pub fn rows(&self) -> Result<Rows, Error> {
        Rows::open(&self.to)
    }
}

/// Writes a file under another name first, so that its own name never stands for a part of it.
fn whole(path: &Path, write: impl FnOnce(&Path) -> io::Result<()>) -> Result<(), Error> {
    let mut name = path.as_os_str().to_owned();
    name.push(".");
    name.push(PART);
    let part = PathBuf::from(name);
    write(&part).and_then(|()| fs::rename(&part, path)).map_err(Error::folder(path))
}

/// Bytes without the permissions that they lie under: a set may come from where nothing may be written.
fn copy(from: &Path, to: &Path) -> io::Result<()> {
    io::copy(&mut fs::File::open(from)?, &mut fs::File::create(to)?).map(|_| ())
}

/// A flow must be that of the frames, and whole. Its vectors are not looked at.
fn check_flow(path: &Path, size: [usize; 2]) -> Result<(), Error> {
    use io::Read;
    let expected = HEADER_OF_FLOW + 8 * size[0] as u64 * size[1] as u64;
    let wrong = |found: String| Error::Flow { path: path.into(), size, expected, found };
    let unreadable = |error: io::Error| wrong(error.to_string());
    let mut file = fs::File::open(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    let mut header = [0; HEADER_OF_FLOW as usize];
    if length < HEADER_OF_FLOW {
        return Err(wrong(format!("{length} bytes")));
    }
    file.read_exact(&mut header).map_err(unreadable)?;
    let [mark, width, height] = [0, 4, 8].map(|at| [header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let [width, height] = [width, height].map(i32::from_le_bytes);
    if &mark != b"PIEH" {
        return Err(wrong(format!("{:?} where \"PIEH\" should be", String::from_utf8_lossy(&mark))));
    }
    if [width as i64, height as i64] != size.map(|side| side as i64) {
        return Err(wrong(format!("{width}×{height}")));
    }
    if length != expected {
        return Err(wrong(format!("{length} bytes")));
    }
    Ok(())
}
