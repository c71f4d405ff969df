//! `models/manifest.toml`: which files make a network, and what they must be to the byte.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Deserializer, de::Error as _};
use sha2::{Digest, Sha256};

use crate::flow::{Error, Precision, network::Golden, padding};

/// What the manifest says of a network that comes as a pyramid and a decoder.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// How the graphs are called: see [`Kind`].
    pub kind: Kind,
    /// ONNX operator set.
    pub opset: u32,
    /// Rows and columns of its images are multiples of this.
    #[serde(default = "six_halvings", deserialize_with = "halvings")]
    pub stride: usize,
    /// The weights' version.
    pub version: String,
    /// The graph that looks at one frame.
    pub pyramid: File,
    /// The graph that finds the flow between two frames' features.
    pub decoder: File,
    /// The same pyramid with the operators of [`crate::flow::convolutions`], if there is one.
    pub pyramid_fused: Option<File>,
    /// The same decoder with those and with [`crate::flow::cost_volume`]'s, if there is one.
    pub fused: Option<File>,
    /// The pyramid with those operators in bf16, if there is one.
    pub pyramid_bf16: Option<File>,
    /// The decoder with them, if there is one.
    pub decoder_bf16: Option<File>,
    /// The graph that brings its flow to every pixel: see [`crate::flow::Resolution::Full`].
    pub upsampler: Option<File>,
    /// Multiply-adds of all convolutions of a step, pyramid and decoder, at 320 × 256, in 10⁹; they grow with the area.
    pub gigamacs: Option<f64>,
    /// Fewer bits than 32 in which its end-point error was measured to stay within 2 % down the brightness ladder.
    #[serde(default)]
    pub precisions: Vec<Precision>,
    /// What the exporter noted.
    pub golden: Option<Golden>,
}

fn six_halvings() -> usize {
    padding::STRIDE
}

/// A power of two, of which a quarter is a whole number.
fn halvings<'de, D: Deserializer<'de>>(from: D) -> Result<usize, D::Error> {
    let found = usize::deserialize(from)?;
    let fits = found.is_power_of_two() && (4..=padding::STRIDE).contains(&found);
    if fits { Ok(found) } else { Err(D::Error::custom(format!("stride should be 4, 8, 16, 32 or 64, it is {found}"))) }
}

impl Entry {
    /// Whether the node's own operators run it in bf16: it has graphs for them, and was judged in so many bits.
    pub fn has_tiles(&self) -> bool {
        self.pyramid_bf16.is_some() && self.decoder_bf16.is_some() && self.precisions.contains(&Precision::Bf16)
    }
}

/// The ways that graphs can be called.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// `image` → features of one frame, named `…level2` where they have a quarter of its rows and columns, and so on; any
    /// of them as `older_…` and `newer_…`, and `scale` → `flow` and `uncertainty`.
    PyramidDecoder,
}

/// One file of the models' folder.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct File {
    /// Its name.
    pub file: String,
    /// Its hash, 64 hexadecimal digits.
    pub sha256: String,
}

/// The folder that holds the manifest: the one that is set, else `models` beside the executable, else the source tree's.
pub fn folder(set: &Path, executable: Option<&Path>) -> PathBuf {
    if !set.as_os_str().is_empty() {
        return set.to_path_buf();
    }
    let beside = executable.and_then(Path::parent).map(|folder| folder.join("models"));
    match beside {
        Some(beside) if beside.join("manifest.toml").exists() => beside,
        _ => Path::new(env!("CARGO_MANIFEST_DIR")).join("models"),
    }
}

/// Every network of the manifest by its name.
pub fn entries(folder: &Path) -> Result<BTreeMap<String, Entry>, Error> {
    let (path, table) = table(folder)?;
    let entry = |(name, value): (String, toml::Value)| match value.try_into() {
        Ok(entry) => Ok((name, entry)),
        Err(e) => Err(Error::Manifest { path: path.clone(), reason: format!("[{name}] {e}") }),
    };
    table.into_iter().map(entry).collect()
}

/// The manifest's entry for `network`. The others may be of a later version.
pub fn entry(folder: &Path, network: &str) -> Result<Entry, Error> {
    let (path, mut table) = table(folder)?;
    let wrong = |reason: String| Error::Manifest { path: path.clone(), reason };
    let names = table.keys().cloned().collect::<Vec<_>>().join(", ");
    let entry =
        table.remove(network).ok_or_else(|| wrong(format!("network {network} is not in it, it has {names}")))?;
    entry.try_into().map_err(|e: toml::de::Error| wrong(format!("[{network}] {e}")))
}

/// The manifest and where it lies.
fn table(folder: &Path) -> Result<(PathBuf, toml::Table), Error> {
    let path = folder.join("manifest.toml");
    let wrong = |reason: String| Error::Manifest { path: path.clone(), reason };
    let text =
        fs::read_to_string(&path).map_err(|e| wrong(format!("{e}; set [flow] models to the folder of the models")))?;
    let table = text.parse().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
    Ok((path, table))
}

/// The bytes of a file, which are what the manifest says.
pub fn read(folder: &Path, file: &File) -> Result<Vec<u8>, Error> {
    let path = folder.join(&file.file);
    let bytes = fs::read(&path).map_err(|e| Error::Manifest { path: path.clone(), reason: e.to_string() })?;
    let found: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    if found != file.sha256 {
        return Err(Error::Hash { path, expected: file.sha256.clone(), found, bytes: bytes.len() });
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An entry with these lines more.
    fn entry(more: &str) -> Result<Entry, toml::de::Error> {
        let files = ["pyramid", "decoder"].map(|part| format!("[{part}]\nfile = \"{part}.onnx\"\nsha256 = \"00\"\n"));
        let head = "kind = \"pyramid_decoder\"\nopset = 17\nversion = \"1\"\n";
        toml::from_str(&format!("{head}{more}\n{}", files.concat()))
    }

    #[test]
    fn a_stride_is_five_halvings_where_it_says_so_and_six_where_it_says_nothing() {
        assert_eq!(entry("").unwrap().stride, 64);
        assert_eq!(entry("stride = 32").unwrap().stride, 32);
        for wrong in [0, 2, 48, 128] {
            let said = entry(&format!("stride = {wrong}")).unwrap_err().to_string();
            assert!(said.contains(&format!("stride should be 4, 8, 16, 32 or 64, it is {wrong}")), "{said}");
        }
    }
}
