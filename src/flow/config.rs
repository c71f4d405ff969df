//! `[flow]`: which network, where its files lie, and from when on its flow is not trusted.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// What raster the flow is given on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resolution {
    /// One vector for every 4 × 4 pixels of the developed image: what the network itself gives.
    #[default]
    Quarter,
    /// One vector for every pixel of the developed image: by the network's upsampler, which follows the image's edges (convex
    /// upsampling, Teed and Deng 2020), or bilinear where the manifest has none for it.
    Full,
    /// One vector for every pixel, always bilinear: what the network's cells know, to be compared.
    Bilinear,
}

/// What computes the decoder's cost volumes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Operators {
    /// One operator of the node's own, see [`crate::flow::cost_volume`], where the network comes with a graph for it.
    #[default]
    Fused,
    /// Operators of ONNX alone.
    Plain,
}

impl std::fmt::Display for Operators {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Operators::Fused => "fused",
            Operators::Plain => "plain",
        })
    }
}

/// What computes the graphs; each must be built into the library that [`Config::runtime`] names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Provider {
    /// ONNX Runtime's own kernels, which every library has.
    #[default]
    Cpu,
    /// Intel's OpenVINO on the processor, also on AMD's.
    OpenVino,
    /// NVIDIA's CUDA and cuDNN. Not run here yet.
    Cuda,
    /// NVIDIA's TensorRT, CUDA for what it can't do. Not run here yet.
    TensorRt,
    /// XNNPACK, for ARM. Not run here yet.
    Xnnpack,
    /// The ARM Compute Library. Not run here yet.
    Acl,
}

/// In how many bits convolutions multiply. Inputs, outputs and cost volumes are of 32 bits always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32 bits.
    #[default]
    Fp32,
    /// 16 bits with the exponent of 32, on processors that have it: by the node's own operators with `cpu`, see
    /// [`crate::flow::convolutions`], or by OpenVINO and TensorRT.
    Bf16,
    /// 16 bits, by TensorRT and ACL.
    Fp16,
}

/// `[flow]`; [`REASONS`] says why each default is what it is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The network's name in `models/manifest.toml`.
    pub network: String,
    /// Folder of the manifest and the graphs; empty: beside the executable, else the source tree it was built from.
    pub models: PathBuf,
    /// File of the ONNX Runtime library; empty: see [`crate::flow::runtime`].
    pub runtime: PathBuf,
    /// Threads of the network.
    pub threads: usize,
    /// Cores that these threads are kept on, one each; empty: wherever there is room.
    pub cores: Vec<usize>,
    /// Real-time priority of the thread that opens the network and of all that it starts, 1 to 99; 0: none. See
    /// [`crate::flow::priority`].
    pub priority: u8,
    /// Move memory to large pages once a size of frames has all of its own, see [`crate::flow::pages`].
    pub large_pages: bool,
    /// What computes cost volumes and convolutions; plain where the network has no fused graph, and for providers other than `cpu`.
    pub operators: Operators,
    /// What computes the graphs.
    pub provider: Provider,
    /// In how many bits.
    pub precision: Precision,
    /// What raster the flow is given on.
    pub resolution: Resolution,
    /// Move the network's vectors to where the images' gradients want them.
    pub refine: bool,
    /// Refine columns of cells by themselves, so that a pole is told from what is behind it.
    pub refine_narrow: bool,
    /// Frames further apart than this are no pair.
    pub gap_ms_max: f64,
    /// Run the network once at start and compare with the values that its exporter noted.
    pub golden_check: bool,
    /// Above this noise (1/255 in the developed image at a mean of 0.4) there is no trustworthy flow.
    pub noise_level_max: f32,
    /// Above this noise flow is to be used with care.
    pub noise_level_degraded: f32,
    /// Below this mean above black (1 = white) there is no trustworthy flow, where the noise is not known.
    pub raw_mean_min: f32,
    /// Below this mean above black flow is to be used with care, where the noise is not known.
    pub raw_mean_degraded: f32,
    /// Above this saturated part of either frame there is no trustworthy flow.
    pub saturated_part_max: f32,
    /// Above this saturated part of either frame flow is to be used with care.
    pub saturated_part_degraded: f32,
    /// Below this mean confidence there is no trustworthy flow.
    pub confidence_min: f32,
    /// Below this mean confidence flow is to be used with care.
    pub confidence_degraded: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            network: "pwcnet_fcdn".into(),
            models: PathBuf::new(),
            runtime: PathBuf::new(),
            threads: 2,
            cores: vec![],
            priority: 0,
            large_pages: true,
            operators: Operators::Fused,
            provider: Provider::Cpu,
            precision: Precision::Fp32,
            resolution: Resolution::Quarter,
            refine: true,
            refine_narrow: false,
            gap_ms_max: 150.0,
            golden_check: true,
            noise_level_max: 75.0,
            noise_level_degraded: 30.0,
            raw_mean_min: 0.001,
            raw_mean_degraded: 0.002,
            saturated_part_max: 0.5,
            saturated_part_degraded: 0.1,
            confidence_min: 0.1,
            confidence_degraded: 0.3,
        }
    }
}

/// Why each default is what it is, by key.
pub const REASONS: &[(&str, &str)] = &[
    (
        "network",
        "PWC-Net without dense connections, trained on dark raw noise: half the multiplications of the dense one",
    ),
    (
        "models",
        "empty: models/ beside the executable, else the source tree, so that a clone and an installation both run",
    ),
    ("runtime", "empty: ORT_DYLIB_PATH, else beside the executable, else where the build put it"),
    ("threads", "2: small boards have four cores, and the camera, the recorder and the autopilot's link need theirs"),
    (
        "cores",
        "empty: the system knows best where there is room; naming them pays where something else would push the network about,          such as cores that are kept free for it (isolcpus)",
    ),
    (
        "priority",
        "0: the system must allow another; with one, other programs on the same cores no longer make one frame in a hundred late \
         (launch_configs/README.md)",
    ),
    (
        "large_pages",
        "true: steps take 4 to 8 % less time, and where the kernel has no such pages or is told to give none nothing happens",
    ),
    (
        "operators",
        "fused: the same flow to a ten-thousandth of a pixel in less time; plain is for comparison and for other runtimes",
    ),
    ("provider", "cpu: the library that the build fetches has no other; models/README.md says what others bring"),
    (
        "precision",
        "fp32: what every processor has, and what the golden output was noted with; bf16 is faster on processors with AMX, which nightflow doctor names, and runs on those with bf16 in AVX-512",
    ),
    (
        "resolution",
        "quarter: the network knows no more than that, and the samples of a finer raster are not independent",
    ),
    (
        "refine",
        "true: gradients know to hundredths of a pixel what a network knows to a tenth; speeds err by half as much \
         (models/velocity.md)",
    ),
    (
        "refine_narrow",
        "false: on a plane, as the ground is, wider windows know more; a camera that looks for obstacles wants it, whose times to \
         contact err by half as much at poles (models/obstacles.md)",
    ),
    ("gap_ms_max", "150: four lost frames at 30 Hz; beyond, a drone's motion leaves the reach of the cost volumes"),
    ("golden_check", "a runtime that computes something else is found at start, for the price of one small pair"),
    (
        "noise_level_max",
        "75: the networks are trained up to 70, and the velocity bench is right to its stated covariance there",
    ),
    (
        "noise_level_degraded",
        "30: the strongest noise of the paper's training set; it means the same by day, by night and for every camera",
    ),
    ("raw_mean_min", "0.001: half of the darkest raw mean that the network is trained for (0.002)"),
    ("raw_mean_degraded", "0.002: the darkest raw mean that the network is trained for"),
    ("saturated_part_max", "0.5: over half of the vectors would stand on pixels that say nothing"),
    ("saturated_part_degraded", "0.1: a lamp or a strip of sky; more than that bends a fit over the image"),
    (
        "confidence_min",
        "0.1: an expected error of 9.5 network pixels, more than the reach of the finest two cost volumes",
    ),
    ("confidence_degraded", "0.3: an expected error of 2.8 network pixels, most of one cell of the raster"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_has_a_reason_and_no_reason_is_left_over() {
        let table = toml::Table::try_from(Config::default()).unwrap();
        let mut keys: Vec<&str> = table.keys().map(String::as_str).collect();
        let mut reasons: Vec<&str> = REASONS.iter().map(|(key, _)| *key).collect();
        keys.sort_unstable();
        reasons.sort_unstable();
        assert_eq!(keys, reasons);
    }

    #[test]
    fn a_misspelt_key_is_refused() {
        let error = toml::from_str::<Config>("thread = 3").unwrap_err().to_string();
        assert!(error.contains("unknown field `thread`"), "{error}");
    }
}
