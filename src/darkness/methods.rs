//! Whatever finds flow between two pictures: our networks, anybody's graph, results of other programs, and no motion.

use std::path::{Path, PathBuf};

use super::{
    enhance::{self, Enhancer},
    flow_files::{self, Field},
    picture::Picture,
};
use crate::{
    clock::Stamp,
    exposure::{Exposed, Pair},
    flow::{
        Config, Error as FlowError, Graph, Matcher, Own, Resolution, manifest,
        padding::{self, Padded, STRIDE},
    },
};

/// What a method is shown.
#[derive(Debug, Clone, Copy)]
pub struct Shown<'a> {
    /// Both frames, of one size.
    pub frames: [&'a Picture; 2],
    /// Where a result of another program lies in its folder: `ENHANCER/CONDITION/PAIR_flow.flo`.
    pub place: &'a Path,
}

/// Why there is no flow.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A network or a graph.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// A file of another program.
    #[error(transparent)]
    File(#[from] flow_files::Error),
    /// A name that says nothing.
    #[error(
        "{given:?} is no model; expected zero, a network of the manifest (as pwcnet_fcdn) or of recipes/ beside it, NAME=FOLDER/NETWORK where \
         FOLDER has a manifest.toml, NAME=FILE.onnx (or NAME=FILE.onnx@1 for inputs of 0…1 instead of 0…255), or \
         NAME=FOLDER of `.flo` files as `ENHANCER/CONDITION/PAIR_flow.flo`"
    )]
    Unknown {
        /// As asked for.
        given: String,
    },
    /// A graph gives something that is no flow of its input.
    #[error(
        "{file}: expected an output of 1 × 2 × rows × columns or 1 × rows × columns × 2 with {height} × {width} rows and \
         columns or a quarter or an eighth of them, found {shape:?}"
    )]
    Shape {
        /// The graph.
        file: String,
        /// Columns that went in.
        width: usize,
        /// Rows that went in.
        height: usize,
        /// What came out.
        shape: Vec<usize>,
    },
    /// An enhancer gives something that is no picture of its input.
    #[error("{file}: expected an output of 1 × 3 × {height} × {width}, found {shape:?}")]
    Picture {
        /// The graph.
        file: String,
        /// Columns that went in.
        width: usize,
        /// Rows that went in.
        height: usize,
        /// What came out.
        shape: Vec<usize>,
    },
}

/// A method and its name in the tables.
pub struct Method {
    /// What the tables call it.
    pub name: String,
    way: Way,
}

enum Way {
    Zero,
    Network(Box<Matcher>, u64),
    Graph { graph: Graph, range: f32 },
    Written(PathBuf),
}

impl Method {
    /// Opens what is named; see [`Error::Unknown`] for the forms. `config` says where models and the runtime are.
    pub fn open(given: &str, config: &Config) -> Result<Self, Error> {
        let network = |name: &str, folder: Option<&Path>| {
            let models = folder.map_or_else(|| home(name, config), Path::to_path_buf);
            // The network itself is judged. What follows it in the node needs to know the camera's noise.
            let resolution = match config.resolution {
                Resolution::Bilinear => Resolution::Bilinear,
                Resolution::Quarter | Resolution::Full => Resolution::Full,
            };
            let refine = false;
            let config = Config { network: name.into(), models, resolution, refine, ..config.clone() };
            Ok::<_, Error>(Way::Network(Box::new(Matcher::open(&config)?), 0))
        };
        let Some((name, path)) = given.split_once('=') else {
            let way = if given == "zero" { Way::Zero } else { network(given, None)? };
            return Ok(Self { name: given.into(), way });
        };
        let (file, range) = path.strip_suffix("@1").map_or((path, 1.0), |file| (file, 1.0f32 / 255.0));
        let (plain, whole) = (Path::new(file), Path::new(path));
        let parent = whole.parent().unwrap_or(Path::new(""));
        let way = if plain.extension().is_some_and(|ending| ending == "onnx") {
            Way::Graph { graph: Graph::open(config, plain, 2)?, range }
        } else if whole.is_dir() && whole.join("manifest.toml").exists() {
            network(name, Some(whole))?
        } else if whole.is_dir() {
            Way::Written(whole.into())
        } else if let (true, Some(inner)) = (parent.join("manifest.toml").exists(), whole.file_name()) {
            network(&inner.to_string_lossy(), Some(parent))?
        } else {
            return Err(Error::Unknown { given: given.into() });
        };
        Ok(Self { name: name.into(), way })
    }

    /// What is known about it, for the report.
    pub fn about(&self) -> String {
        match &self.way {
            Way::Zero => "no motion anywhere".into(),
            Way::Network(matcher, _) => {
                let model = matcher.model();
                let hashes: Vec<String> = model.sha256.iter().map(|(file, hash)| format!("{file} {hash}")).collect();
                format!("{} {}, {}, {}", model.name, model.version, model.provider, hashes.join(", "))
            }
            Way::Graph { graph, range } => format!("{}, inputs 0…{}", graph.file(), 255.0 * range),
            Way::Written(folder) => format!("computed by another program into {}", folder.display()),
        }
    }

    /// Whether it can have anything of its own for frames that went through this enhancer.
    pub fn covers(&self, enhancer: &Enhancer) -> bool {
        match &self.way {
            // It looks at no frame.
            Way::Zero => *enhancer == Enhancer::None,
            Way::Written(folder) => folder.join(enhancer.to_string()).is_dir(),
            _ => true,
        }
    }

    /// Flow on every pixel of the first picture.
    pub fn flow(&mut self, shown: &Shown<'_>) -> Result<Field, Error> {
        let (width, height) = (shown.frames[0].width, shown.frames[0].height);
        let vectors = match &mut self.way {
            Way::Zero => vec![[0.0; 2]; width * height],
            Way::Network(matcher, generation) => {
                *generation += 2;
                let [older, newer] = [0, 1].map(|frame| developed(shown.frames[frame], *generation + frame as u64));
                let pair = Pair { older: &older, newer: &newer, gain_step: None };
                let mut memory = Own::default();
                matcher.between(&pair, &mut memory)?.vectors.as_chunks::<2>().0.to_vec()
            }
            Way::Graph { graph, range } => of_graph(graph, *range, shown.frames)?,
            Way::Written(folder) => return Ok(flow_files::read(&folder.join(shown.place))?),
        };
        Ok(Field { width, height, vectors, valid: None })
    }
}

/// Folder of models, under the one that holds the manifest, of networks that are there to be compared and not to be flown.
const RECIPES: &str = "recipes";

/// The folder of the models that has this network: the settings', or the one of recipes in it.
fn home(name: &str, config: &Config) -> PathBuf {
    let models = manifest::folder(&config.models, std::env::current_exe().ok().as_deref());
    let beside = models.join(RECIPES);
    let compared = manifest::entry(&models, name).is_err() && manifest::entry(&beside, name).is_ok();
    if compared { beside } else { models }
}

/// A picture as the network takes it.
fn developed(picture: &Picture, generation: u64) -> Exposed {
    Exposed {
        stamp: Stamp(generation as i64),
        width: picture.width,
        height: picture.height,
        scale: [1.0; 2],
        rgb: picture.planar(1.0 / 255.0),
        saturated: vec![0; picture.width * picture.height],
        gain: 1.0,
        generation,
        ..Exposed::default()
    }
}

fn of_graph(graph: &mut Graph, range: f32, frames: [&Picture; 2]) -> Result<Vec<[f32; 2]>, Error> {
    let (width, height) = (frames[0].width, frames[0].height);
    let (wide, high) = (padding::padded(width, STRIDE), padding::padded(height, STRIDE));
    let images = frames.map(|frame| {
        let exposed = Exposed { width, height, rgb: frame.planar(range), ..Exposed::default() };
        let mut image = vec![0.0; 3 * wide * high];
        Padded::new(&exposed, STRIDE).write(&mut image);
        image
    });
    let (shape, values) = graph.run(&[&images[0], &images[1]], wide, high)?;
    let wrong = || Error::Shape { file: graph.file().into(), width: wide, height: high, shape: shape.clone() };
    let [1, a, b, c] = shape[..] else { return Err(wrong()) };
    let (planar, rows, columns) = match (a, c) {
        (2, _) => (true, b, c),
        (_, 2) => (false, a, b),
        _ => return Err(wrong()),
    };
    let factor = [1, 4, 8].into_iter().find(|factor| rows * factor == high && columns * factor == wide);
    let factor = factor.ok_or_else(wrong)?;
    let cells = rows * columns;
    let at = |cell: usize| {
        if planar { [values[cell], values[cells + cell]] } else { [values[2 * cell], values[2 * cell + 1]] }
    };
    Ok(enlarged(&(0..cells).map(at).collect::<Vec<_>>(), (columns, rows), factor, (width, height)))
}

/// Bilinear, half-pixel-exact, flat beyond the outermost cells' centres, cut to `width` × `height`.
fn enlarged(
    cells: &[[f32; 2]],
    (columns, rows): (usize, usize),
    factor: usize,
    (width, height): (usize, usize),
) -> Vec<[f32; 2]> {
    let between = |pixel: usize, count: usize| {
        let place = ((pixel as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, (count - 1) as f32);
        let first = place as usize;
        (first, (first + 1).min(count - 1), place - first as f32)
    };
    let mix = |a: [f32; 2], b: [f32; 2], part: f32| [a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1])];
    let pixel = |at: usize| {
        let (left, right, along) = between(at % width, columns);
        let (upper, lower, down) = between(at / width, rows);
        let row = |y: usize| mix(cells[y * columns + left], cells[y * columns + right], along);
        mix(row(upper), row(lower), down)
    };
    (0..width * height).map(pixel).collect()
}

/// An enhancement, ready to run.
pub struct Enhancing {
    /// Which.
    pub by: Enhancer,
    graph: Option<Graph>,
}

impl Enhancing {
    /// Loads what there is to load.
    pub fn open(by: Enhancer, config: &Config) -> Result<Self, Error> {
        let graph = match &by {
            Enhancer::Onnx(file) => Some(Graph::open(config, file, 1)?),
            _ => None,
        };
        Ok(Self { by, graph })
    }

    /// The enhanced frame.
    pub fn enhance(&mut self, frame: &Picture) -> Result<Picture, Error> {
        let Some(graph) = &mut self.graph else {
            return Ok(enhance::enhance(&self.by, frame).unwrap_or_else(|| frame.clone()));
        };
        let (width, height) = (frame.width, frame.height);
        let (wide, high) = (padding::padded(width, STRIDE), padding::padded(height, STRIDE));
        let exposed = Exposed { width, height, rgb: frame.planar(1.0 / 255.0), ..Exposed::default() };
        let mut image = vec![0.0; 3 * wide * high];
        Padded::new(&exposed, STRIDE).write(&mut image);
        let (shape, values) = graph.run(&[&image], wide, high)?;
        if shape != [1, 3, high, wide] {
            return Err(Error::Picture { file: graph.file().into(), width: wide, height: high, shape });
        }
        let at = |i: usize| values[(i % 3) * wide * high + i / 3 / width * wide + i / 3 % width];
        let interleaved: Vec<f32> = (0..3 * width * height).map(at).collect();
        Ok(Picture::from_unit(width, height, &interleaved))
    }
}
