//! The session: a pyramid and a decoder in ONNX Runtime. The only file of this stage that is not pure.

use std::{
    env,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use ort::{
    environment::Environment,
    memory::{Allocator, MemoryInfo},
    session::{
        IoBinding, Session,
        builder::{GraphOptimizationLevel, SessionBuilder},
    },
    value::{Outlet, Shape, Tensor, TensorRefMut, ValueType},
};
use tracing::info;

use crate::flow::{
    Config, Error, Operators, Precision, Provider, convolutions, cores,
    manifest::{self, Kind},
    network::{Golden, Model, Network, Raster, Slot},
    operators,
    padding::Padded,
    provider,
    runtime::{self, Tried},
};

/// One kind of features that the pyramid gives for a frame.
struct Feature {
    /// The pyramid's output. The decoder takes it as `older_…`, as `newer_…`, or both.
    name: String,
    /// It has 1/2^level of the image's rows and columns.
    level: usize,
    channels: usize,
    /// The names under which the decoder reads the older and the newer frame's, where it does.
    read_as: [Option<String>; 2],
}

/// A pyramid and a decoder with their memory.
///
/// Features stay in ONNX Runtime's own memory: the pyramid's outputs are bound to the very tensors that the decoder's
/// inputs are bound to, one set for each slot.
pub struct Onnx {
    pyramid: Graph,
    decoder: Graph,
    features: Vec<Feature>,
    memory: Option<Memory>,
    scale: Tensor<f32>,
    stride: usize,
    golden: Option<Golden>,
    model: Model,
    copied: u64,
    /// What it takes to open the graphs again for a size, for providers that are faster where they know it.
    fixed: Option<Fixed>,
}

/// Graphs that are opened for one size of images at a time.
struct Fixed {
    loaded: Loaded,
    config: Config,
    /// The pyramid's and the decoder's.
    bytes: [Vec<u8>; 2],
}

/// A session and what is bound to it. Bindings must not outlive their session, hence the order of the fields.
struct Graph {
    binding: IoBinding,
    session: Session,
}

/// The tensors for one size of image.
struct Memory {
    width: usize,
    height: usize,
    image: Tensor<f32>,
    features: [Vec<Tensor<f32>>; 2],
}

/// An error of ONNX Runtime, with what it was asked to do.
pub(super) fn failed<R>(doing: &'static str) -> impl Fn(ort::Error<R>) -> Error {
    move |error| Error::Session { doing, reason: error.to_string() }
}

/// A loaded library, and the file that it came from.
pub(super) type Loaded = (Environment, PathBuf);

/// Loads the library once: a process can hold one only, and one environment of it.
pub(super) fn environment(config: &Config) -> Result<Loaded, Error> {
    static LOADED: Mutex<Option<Loaded>> = Mutex::new(None);
    let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
    let executable = env::current_exe().ok();
    let variable = env::var_os("ORT_DYLIB_PATH").map(Into::into);
    let mut tried = Vec::new();
    for place in runtime::places(&config.runtime, variable, executable.as_deref()) {
        let reason = match (&*loaded, place.path.exists()) {
            (_, false) => "there is no such file".into(),
            (Some(held), true) if held.1 == place.path => return Ok(held.clone()),
            (Some((_, held)), true) => format!("this process has loaded {} already", held.display()),
            (None, true) => match ort::init_from(&place.path) {
                Ok(builder) => {
                    let environment = builder.with_name("nightflow").build().map_err(failed("start"))?;
                    return Ok(loaded.insert((environment, place.path)).clone());
                }
                Err(error) => error.to_string(),
            },
        };
        tried.push(Tried { place, reason });
    }
    Err(Error::Runtime { tried })
}

/// Loads a graph, one at a time in a process: ONNX Runtime (1.24) writes the name of our operators' domain into a table that
/// all sessions read, without a lock, and two at once fail (microsoft/onnxruntime issue 22663) or worse.
pub(super) fn load(mut builder: SessionBuilder, bytes: &[u8]) -> Result<Session, Error> {
    static LOADING: Mutex<()> = Mutex::new(());
    let _alone = LOADING.lock().unwrap_or_else(PoisonError::into_inner);
    builder.commit_from_memory(bytes).map_err(failed("load a graph"))
}

/// The names of the graphs' dimensions, and their lengths for images of this size.
fn dimensions([width, height]: [usize; 2]) -> impl Iterator<Item = (String, i64)> {
    let whole = [("width".to_owned(), width as i64), ("height".to_owned(), height as i64)];
    let level = move |level: usize| {
        let of = |name: &str, length: usize| (format!("{name}_level{level}"), (length >> level) as i64);
        [of("columns", width), of("rows", height)]
    };
    whole.into_iter().chain((0..=6).flat_map(level))
}

impl Graph {
    /// Sequential, with a fixed number of threads: the order of every sum is fixed, so a replay gives the same bytes.
    ///
    /// `size` fixes the columns and rows of the images, by the names that the graphs give their dimensions; `profile` is where
    /// a name for the record of what each node takes begins.
    fn open(
        (environment, library): &Loaded,
        bytes: &[u8],
        config: &Config,
        size: Option<[usize; 2]>,
        profile: Option<&Path>,
    ) -> Result<Self, Error> {
        let doing = "set up a session";
        let mut session = Session::builder(environment)
            .map_err(failed(doing))?
            .with_intra_threads(config.threads.max(1))
            .map_err(failed(doing))?
            .with_inter_threads(1)
            .map_err(failed(doing))?
            .with_parallel_execution(false)
            .map_err(failed(doing))?
            .with_deterministic_compute(true)
            .map_err(failed(doing))?
            .with_optimization_level(GraphOptimizationLevel::All)
            .map_err(failed(doing))?
            // Threads that spin for their next work between two frames would take the cores from the other stages.
            .with_config_entry("session.force_spinning_stop", "1")
            .map_err(failed(doing))?
            .with_config_entry(provider::RECORD, "1")
            .map_err(failed(doing))?
            .with_operators(operators::domain().map_err(failed("make its operators"))?)
            .map_err(failed(doing))?
            .with_execution_providers(provider::wanted(config, library)?)
            .map_err(failed("start the execution provider"))?;
        if let Some(workers) = cores::of_workers(&config.cores) {
            let key = "session.intra_op_thread_affinities";
            session = session.with_config_entry(key, workers).map_err(failed(doing))?;
        }
        if let Some(begin) = profile {
            session = session.with_profiling(begin).map_err(failed(doing))?;
        }
        for (name, length) in size.into_iter().flat_map(dimensions) {
            session = session.with_dimension_override(name, length).map_err(failed(doing))?;
        }
        let session = load(session, bytes)?;
        let binding = session.create_binding().map_err(failed("bind"))?;
        Ok(Self { binding, session })
    }

    fn inputs(&self) -> Vec<&str> {
        self.session.inputs().iter().map(Outlet::name).collect()
    }

    fn outputs(&self) -> Vec<&str> {
        self.session.outputs().iter().map(Outlet::name).collect()
    }
}

/// Refuses names that are not exactly those that are wanted, in any order.
fn same(file: &str, found: &[&str], wanted: &[&str]) -> Result<(), Error> {
    if wanted.len() != found.len() || wanted.iter().any(|name| !found.contains(name)) {
        return Err(Error::Interface { file: file.into(), wanted: wanted.join(", "), found: found.join(", ") });
    }
    Ok(())
}

/// What the pyramid gives and the decoder reads: outputs `…level3` of [1, channels, rows / 8, columns / 8], and so on.
fn features(entry: &manifest::Entry, pyramid: &Graph, decoder: &Graph) -> Result<Vec<Feature>, Error> {
    let unfit = |file: &manifest::File, wanted: &str, found: String| Error::Interface {
        file: file.file.clone(),
        wanted: wanted.into(),
        found,
    };
    same(&entry.pyramid.file, &pyramid.inputs(), &["image"])?;
    same(&entry.decoder.file, &decoder.outputs(), &["flow", "uncertainty"])?;
    let mut unread = decoder.inputs();
    let mut read = |name: String| {
        let place = unread.iter().position(|input| *input == name)?;
        unread.remove(place);
        Some(name)
    };
    let scaled = read("scale".into());
    let feature = |outlet: &Outlet| {
        let name = outlet.name();
        let level = name.rsplit_once("level").and_then(|(_, level)| level.parse().ok()).filter(|level| *level <= 6)?;
        let ValueType::Tensor { shape, .. } = outlet.dtype() else { return None };
        let channels = usize::try_from(*shape.get(1)?).ok().filter(|&count| count > 0 && shape.len() == 4)?;
        let read_as = ["older", "newer"].map(|frame| read(format!("{frame}_{name}")));
        Some(Feature { name: name.into(), level, channels, read_as })
    };
    let given: Option<Vec<Feature>> = pyramid.session.outputs().iter().map(feature).collect();
    let given = given.filter(|given| !given.is_empty()).ok_or_else(|| {
        let wanted = "outputs named …level0 to …level6, each [1, a fixed number of channels, rows, columns]";
        unfit(&entry.pyramid, wanted, format!("{:?}", pyramid.session.outputs()))
    })?;
    if scaled.is_none() || !unread.is_empty() {
        let names = |given: &[Feature]| given.iter().map(|feature| feature.name.clone()).collect::<Vec<_>>().join(", ");
        let wanted = format!("scale, and older_ and newer_ before any of {}", names(&given));
        return Err(unfit(&entry.decoder, &wanted, decoder.inputs().join(", ")));
    }
    Ok(given)
}

/// What computes cost volumes and convolutions; the entry's graphs become those for it.
fn chosen(config: &Config, entry: &mut manifest::Entry) -> Result<Operators, Error> {
    let Config { operators, provider, precision, .. } = *config;
    if provider == Provider::Cpu && precision == Precision::Bf16 {
        let unfit = |reason: String| Error::Tiles { reason };
        if operators == Operators::Plain {
            return Err(unfit(
                "it is computed by the node's own operators, which operators = \"plain\" forbids".into(),
            ));
        }
        if !convolutions::Unit::best().is_fast() {
            let reason = "it needs Linux and a processor with bf16 in AVX-512 (AMD's since Zen 4) or AMX (Intel's Xeons since 2023), \
                          which this machine hasn't; fp32 runs anywhere";
            return Err(unfit(reason.into()));
        }
        let Some((pyramid, decoder)) = entry.pyramid_bf16.take().zip(entry.decoder_bf16.take()) else {
            return Err(unfit(format!("{} has no graphs for it; provider = \"openvino\" needs none", config.network)));
        };
        (entry.pyramid, entry.decoder) = (pyramid, decoder);
        return Ok(Operators::Fused);
    }
    if operators == Operators::Fused && provider != Provider::Cpu {
        // Between two calls of our operator another provider's threads and the runtime's wait for each other, which costs
        // more than the operator saves.
        info!("provider {provider:?} is given the whole decoder, with plain operators");
        return Ok(Operators::Plain);
    }
    Ok(match (operators, entry.fused.take()) {
        (Operators::Fused, Some(fused)) => {
            entry.decoder = fused;
            if let Some(pyramid) = entry.pyramid_fused.take() {
                entry.pyramid = pyramid;
            }
            Operators::Fused
        }
        (Operators::Fused, None) => {
            info!("{} has no graph with fused operators, its plain one runs", config.network);
            Operators::Plain
        }
        (Operators::Plain, _) => Operators::Plain,
    })
}

impl Onnx {
    /// Finds the library and the network that the settings name, and checks both.
    pub fn open(config: &Config) -> Result<Self, Error> {
        Self::open_with(config, None)
    }

    /// The same, but what every node takes is recorded into two files of this folder.
    pub fn profiled(config: &Config, folder: &Path) -> Result<Self, Error> {
        Self::open_with(config, Some(folder))
    }

    fn open_with(config: &Config, profiles: Option<&Path>) -> Result<Self, Error> {
        let loaded = environment(config)?;
        let executable = env::current_exe().ok();
        let folder = manifest::folder(&config.models, executable.as_deref());
        let mut entry = manifest::entry(&folder, &config.network)?;
        let Kind::PyramidDecoder = entry.kind;
        let precision = config.precision;
        if precision != Precision::Fp32 && !entry.precisions.contains(&precision) {
            let able =
                manifest::entries(&folder)?.into_iter().filter(|(_, entry)| entry.precisions.contains(&precision));
            let able: Vec<String> = able.map(|(name, _)| name).collect();
            let able = if able.is_empty() { "none".into() } else { able.join(", ") };
            return Err(Error::Coarse { network: config.network.clone(), precision, able });
        }
        let operators = chosen(config, &mut entry)?;
        let bytes = [manifest::read(&folder, &entry.pyramid)?, manifest::read(&folder, &entry.decoder)?];
        let open = |bytes: &[u8], part: &str| {
            Graph::open(&loaded, bytes, config, None, profiles.map(|folder| folder.join(part)).as_deref())
        };
        let (pyramid, decoder) = (open(&bytes[0], "pyramid")?, open(&bytes[1], "decoder")?);
        let features = features(&entry, &pyramid, &decoder)?;
        let mut assigned = provider::assigned(&pyramid.session).map_err(failed("name its providers"))?;
        for (name, count) in provider::assigned(&decoder.session).map_err(failed("name its providers"))? {
            *assigned.entry(name).or_insert(0) += count;
        }
        provider::check(config, &assigned)?;
        let library = loaded.1.clone();
        let tiles = config.provider == Provider::Cpu && precision == Precision::Bf16;
        let unit = convolutions::Unit::best().name();
        let tiles = if tiles { format!(", its convolutions the node's own, in bf16 by {unit}") } else { String::new() };
        let provider = format!("{} of ONNX Runtime {}{tiles}", provider::named(&assigned), provider::version(&library));
        let fixes = config.provider.fixes_sizes();
        let fixed = fixes.then(|| Fixed { loaded: loaded.clone(), config: config.clone(), bytes });
        let sha256 = [entry.pyramid, entry.decoder].into_iter().map(|file| (file.file, file.sha256)).collect();
        Ok(Self {
            pyramid,
            decoder,
            features,
            memory: None,
            scale: Tensor::from_array(([2usize], vec![1.0f32, 1.0])).map_err(failed("reserve memory"))?,
            stride: entry.stride,
            golden: entry.golden,
            model: Model { name: config.network.clone(), version: entry.version, sha256, operators, provider, library },
            copied: 0,
            fixed,
        })
    }

    /// The tensors for this size; new ones where it has changed.
    fn memory(&mut self, width: usize, height: usize) -> Result<&mut Memory, Error> {
        let fits = self.memory.as_ref().is_some_and(|memory| (memory.width, memory.height) == (width, height));
        if !fits {
            self.pyramid.binding.clear();
            self.decoder.binding.clear();
            self.memory = None;
            if let Some(Fixed { loaded, config, bytes: [pyramid, decoder] }) = &self.fixed {
                let size = Some([width, height]);
                self.pyramid = Graph::open(loaded, pyramid, config, size, None)?;
                self.decoder = Graph::open(loaded, decoder, config, size, None)?;
            }
            self.memory = Some(Memory::new(width, height, &self.features).map_err(failed("reserve memory"))?);
        }
        // The branch above has just filled it.
        self.memory.as_mut().ok_or(Error::Session { doing: "reserve memory", reason: "there is none".into() })
    }
}

impl Memory {
    fn new(width: usize, height: usize, features: &[Feature]) -> ort::Result<Self> {
        let allocator = Allocator::default();
        let tensor = |Feature { level, channels, .. }: &Feature| {
            Tensor::<f32>::new(&allocator, [1, *channels, height >> level, width >> level])
        };
        let slot = || features.iter().map(tensor).collect::<ort::Result<Vec<_>>>();
        let image = Tensor::<f32>::new(&allocator, [1, 3, height, width])?;
        Ok(Self { width, height, image, features: [slot()?, slot()?] })
    }
}

impl Network for Onnx {
    fn stride(&self) -> usize {
        self.stride
    }

    fn end_profile(&mut self) -> Result<Vec<PathBuf>, Error> {
        let sessions = [&mut self.pyramid.session, &mut self.decoder.session];
        let end = |session: &mut Session| session.end_profiling().map_err(failed("end its record"));
        sessions.map(end).into_iter().map(|file| file.map(PathBuf::from)).collect()
    }

    fn describe(&mut self, slot: Slot, image: &Padded<'_>) -> Result<(), Error> {
        self.memory(image.width, image.height)?;
        let Some(memory) = &mut self.memory else { return Ok(()) };
        image.write(memory.image.extract_tensor_mut().1);
        let Graph { binding, session } = &mut self.pyramid;
        let mut run = || -> ort::Result<()> {
            binding.bind_input("image", &memory.image)?;
            for (feature, tensor) in self.features.iter().zip(&mut memory.features[slot.index()]) {
                binding.bind_output(&feature.name, tensor)?;
            }
            session.run_binding(binding).map(drop)
        };
        run().map_err(failed("run the pyramid"))
    }

    fn between(&mut self, older: Slot, scale: [f32; 2], out: Raster<'_>) -> Result<(), Error> {
        let Some(memory) = &self.memory else {
            return Err(Error::Session { doing: "run the decoder", reason: "no frame was looked at yet".into() });
        };
        let (rows, columns) = (memory.height / 4, memory.width / 4);
        if out.flow.len() != rows * columns * 2 || out.uncertainty.len() != rows * columns {
            return Err(Error::Lent { cells: rows * columns, flow: out.flow.len(), confidence: out.uncertainty.len() });
        }
        self.scale.extract_tensor_mut().1.copy_from_slice(&scale);
        let Graph { binding, session } = &mut self.decoder;
        let mut run = || -> ort::Result<u64> {
            for (frame, slot) in [older, older.other()].into_iter().enumerate() {
                for (feature, tensor) in self.features.iter().zip(&memory.features[slot.index()]) {
                    if let Some(name) = &feature.read_as[frame] {
                        binding.bind_input(name, tensor)?;
                    }
                }
            }
            binding.bind_input("scale", &self.scale)?;
            bind(binding, "flow", out.flow, &[1, rows, columns, 2])?;
            bind(binding, "uncertainty", out.uncertainty, &[1, rows, columns])?;
            let outputs = session.run_binding(binding)?;
            let mut copied = 0;
            for (name, memory) in [("flow", &mut *out.flow), ("uncertainty", &mut *out.uncertainty)] {
                let (_, values) = outputs[name].try_extract_tensor::<f32>()?;
                // Bound memory is written in place; should a provider keep memory of its own, its values are fetched.
                if values.as_ptr() != memory.as_ptr() {
                    memory.copy_from_slice(values);
                    copied += 1;
                }
            }
            Ok(copied)
        };
        let result = run();
        // Before anything else: the lent memory is not ours after this call.
        binding.clear_outputs();
        self.copied += result.map_err(failed("run the decoder"))?;
        Ok(())
    }

    fn model(&self) -> &Model {
        &self.model
    }

    fn golden(&self) -> Option<&Golden> {
        self.golden.as_ref()
    }

    fn copied(&self) -> u64 {
        self.copied
    }
}

/// Binds an output to memory of the caller's. The caller clears the binding before that memory goes.
fn bind(binding: &mut IoBinding, name: &str, memory: &mut [f32], shape: &[usize]) -> ort::Result<()> {
    let shape = Shape::new(shape.iter().map(|&length| length as i64));
    debug_assert_eq!(shape.num_elements(), memory.len());
    // SAFETY: the pointer is valid for as many f32 in CPU memory as the shape says, and `between` clears the binding
    // before the borrow of that memory ends.
    let tensor: TensorRefMut<'_, f32> =
        unsafe { TensorRefMut::from_raw(MemoryInfo::default(), memory.as_mut_ptr().cast(), shape)? };
    binding.bind_output(name, tensor)
}
