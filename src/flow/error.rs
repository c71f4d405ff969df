//! Why this stage fails: at start for good, or for one step.

use std::path::PathBuf;

use crate::flow::{
    Precision,
    runtime::{self, Tried},
};

/// Why there is no network, or why it spoils a step.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// ONNX Runtime was not found or does not load.
    #[error(
        "ONNX Runtime {} is needed and was not found. Tried:{}\nTo install it: {}",
        runtime::VERSION,
        tried.iter().map(Tried::to_string).collect::<String>(),
        runtime::remedy()
    )]
    Runtime {
        /// Every place that was looked at.
        tried: Vec<Tried>,
    },
    /// What the network's nodes take was not recorded, or cannot be read.
    #[error("{}: {reason}", path.display())]
    Profile {
        /// The record.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The network's threads cannot be kept on these cores.
    #[error("[flow] cores = {cores:?}: {why}")]
    Cores {
        /// As set.
        cores: Vec<usize>,
        /// What is wrong, and what is expected.
        why: String,
    },
    /// The network's threads cannot have this priority.
    #[error("[flow] priority = {priority}: {why}")]
    Priority {
        /// As set.
        priority: u8,
        /// What is wrong, and what is expected.
        why: String,
    },
    /// The manifest or a file of it cannot be read.
    #[error("{}: {reason}", path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A graph is not the one that the manifest means.
    #[error("{} ({bytes} bytes) has sha256 {found}, the manifest says {expected}; fetch the models again", path.display())]
    Hash {
        /// The file.
        path: PathBuf,
        /// The manifest's.
        expected: String,
        /// The file's.
        found: String,
        /// The file's length.
        bytes: usize,
    },
    /// A graph cannot be called as its kind is called.
    #[error("{file}: expected {wanted}, it has {found}")]
    Interface {
        /// The file.
        file: String,
        /// The names that it is called by.
        wanted: String,
        /// The names that it has.
        found: String,
    },
    /// The manifest's golden output does not fit its own size.
    #[error(
        "the golden output should hold {cells} cells, it has {flow} values of flow and {uncertainty} of uncertainty"
    )]
    GoldenSize {
        /// Cells.
        cells: usize,
        /// Values; two a cell are expected.
        flow: usize,
        /// Values; one a cell is expected.
        uncertainty: usize,
    },
    /// The network computes something else here than where it was exported.
    #[error(
        "the golden output differs at row {row}, column {column}: {found} where the exporter noted {wanted} (± {tolerance})"
    )]
    Golden {
        /// Row of the raster.
        row: usize,
        /// Column of the raster.
        column: usize,
        /// Noted.
        wanted: f32,
        /// Computed.
        found: f32,
        /// Allowed.
        tolerance: f32,
    },
    /// ONNX Runtime refuses.
    #[error("ONNX Runtime could not {doing}: {reason}")]
    Session {
        /// What it was asked.
        doing: &'static str,
        /// Its words.
        reason: String,
    },
    /// The library was built without the execution provider that the settings name.
    #[error("[flow] provider = {wanted:?}: {} was built with {built} only. To have it: {remedy}", library.display())]
    Provider {
        /// The settings' word.
        wanted: String,
        /// The library.
        library: PathBuf,
        /// What it was built with, in the settings' words.
        built: String,
        /// What to do.
        remedy: &'static str,
    },
    /// The execution provider does not compute in so many bits.
    #[error("[flow] precision = \"{}\": provider {provider:?} can do {able}", format!("{precision:?}").to_lowercase())]
    Precision {
        /// The settings' word.
        provider: String,
        /// What is wanted.
        precision: Precision,
        /// What there is.
        able: String,
    },
    /// The node's own operators can't compute in so many bits here.
    #[error("[flow] precision = \"bf16\" with provider = \"cpu\": {reason}")]
    Tiles {
        /// Why not, and what to do.
        reason: String,
    },
    /// The network was not shown to be as good in so many bits.
    #[error(
        "[flow] precision = \"{}\": {network} was not shown to keep its error in it to 2 %, it runs in fp32; those that were: {able}",
        format!("{precision:?}").to_lowercase()
    )]
    Coarse {
        /// The network.
        network: String,
        /// What is wanted.
        precision: Precision,
        /// The manifest's networks that were.
        able: String,
    },
    /// ONNX Runtime gave no part of the network to the execution provider that the settings name.
    #[error("[flow] provider = {wanted:?}: no node of {network} was given to it, all run on {found}")]
    Unassigned {
        /// The settings' word.
        wanted: String,
        /// The network.
        network: String,
        /// What runs instead.
        found: String,
    },
    /// An image contradicts itself. Spoils one step.
    #[error("an image of {width} × {height} pixels has {rgb} values and {saturated} of saturation")]
    Image {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Three a pixel are expected.
        rgb: usize,
        /// One a pixel is expected.
        saturated: usize,
    },
    /// The frames of a pair are of different size. Spoils one step.
    #[error("the older frame (width, height, scale) is {older:?}, the newer {newer:?}")]
    Differ {
        /// Columns, rows, camera pixels per pixel.
        older: (usize, usize, [f32; 2]),
        /// Columns, rows, camera pixels per pixel.
        newer: (usize, usize, [f32; 2]),
    },
    /// The lent memory does not fit the raster. Spoils one step.
    #[error("the raster has {cells} cells, but room was lent for {flow} values of flow and {confidence} of confidence")]
    Lent {
        /// Cells.
        cells: usize,
        /// Two a cell are expected.
        flow: usize,
        /// One a cell is expected.
        confidence: usize,
    },
    /// The network's answer is no number. Spoils one step.
    #[error(
        "the network gave {flow} of {of_flow} flow values and {uncertainty} of {of} uncertainties that are not finite"
    )]
    NotFinite {
        /// Values that are not finite.
        flow: usize,
        /// All values.
        of_flow: usize,
        /// Values that are not finite.
        uncertainty: usize,
        /// All values.
        of: usize,
    },
}
