//! Any single graph of images, as others export them: an enhancer of one frame, or a network that takes two at once.

use std::path::Path;

use ort::{
    session::{Session, builder::GraphOptimizationLevel},
    value::TensorRef,
};

use crate::flow::{
    Config, Error, cores,
    onnx::{environment, failed, load},
};

/// A graph whose inputs are images of one size and whose first output is taken.
pub struct Graph {
    session: Session,
    file: String,
    inputs: Vec<String>,
}

impl Graph {
    /// Loads `path` with the runtime and the threads of the settings; it must have this many inputs.
    pub fn open(config: &Config, path: &Path, inputs: usize) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|e| Error::Manifest { path: path.into(), reason: e.to_string() })?;
        Self::of(config, path.display().to_string(), &bytes, inputs)
    }

    /// The same of a graph's bytes, which are called `file` in errors.
    pub fn of(config: &Config, file: String, bytes: &[u8], inputs: usize) -> Result<Self, Error> {
        let (environment, _) = environment(config)?;
        let doing = "set up a session";
        let mut session = Session::builder(&environment)
            .map_err(failed(doing))?
            .with_intra_threads(config.threads.max(1))
            .map_err(failed(doing))?
            .with_deterministic_compute(true)
            .map_err(failed(doing))?
            .with_optimization_level(GraphOptimizationLevel::All)
            .map_err(failed(doing))?
            // Threads that spin after a run would take the cores from whatever comes next.
            .with_config_entry("session.force_spinning_stop", "1")
            .map_err(failed(doing))?;
        if let Some(workers) = cores::of_workers(&config.cores) {
            let key = "session.intra_op_thread_affinities";
            session = session.with_config_entry(key, workers).map_err(failed(doing))?;
        }
        let session = load(session, bytes)?;
        let found: Vec<String> = session.inputs().iter().map(|outlet| outlet.name().to_owned()).collect();
        if found.len() != inputs {
            let wanted = format!("{inputs} input{} of images, NCHW", if inputs == 1 { "" } else { "s" });
            return Err(Error::Interface { file, wanted, found: format!("{}: {}", found.len(), found.join(", ")) });
        }
        Ok(Self { session, file, inputs: found })
    }

    /// Runs the graph on images of 3 × `height` × `width` values, in the order of its inputs; gives the shape and the
    /// values of the first output.
    pub fn run(&mut self, images: &[&[f32]], width: usize, height: usize) -> Result<(Vec<usize>, Vec<f32>), Error> {
        let lengths = [1, 3, height, width];
        let inputs: Vec<_> = images.iter().map(|image| (*image, &lengths[..])).collect();
        self.run_on(&inputs)
    }

    /// The same on tensors of any lengths.
    pub fn run_on(&mut self, tensors: &[(&[f32], &[usize])]) -> Result<(Vec<usize>, Vec<f32>), Error> {
        let mut first = (vec![], vec![]);
        self.run_into(tensors, |at, lengths, values| {
            if at == 0 {
                first = (lengths.iter().map(|&length| length.max(0) as usize).collect(), values.to_vec());
            }
        })?;
        Ok(first)
    }

    /// The same; gives every output's number, shape and values to whoever asks.
    pub(super) fn run_into(
        &mut self,
        tensors: &[(&[f32], &[usize])],
        mut take: impl FnMut(usize, &[i64], &[f32]),
    ) -> Result<(), Error> {
        let mut inputs = Vec::with_capacity(tensors.len());
        for (name, &(values, lengths)) in self.inputs.iter().zip(tensors) {
            let tensor = TensorRef::from_array_view((lengths, values));
            inputs.push((name.clone(), tensor.map_err(failed("take a tensor"))?));
        }
        let outputs = self.session.run(inputs).map_err(failed("run the graph"))?;
        for (at, (_, value)) in outputs.iter().enumerate() {
            let (shape, values) = value.try_extract_tensor::<f32>().map_err(failed("give a result"))?;
            take(at, shape, values);
        }
        Ok(())
    }

    /// The file that it came from.
    pub fn file(&self) -> &str {
        &self.file
    }
}
