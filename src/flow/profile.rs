//! How long each kind of a network's operators takes, by ONNX Runtime's own record.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use serde::Deserialize;

use super::{Config, Error, Matcher, Own, onnx::Onnx};
use crate::exposure::{Exposed, Pair};

/// One event of the record, which is that of Chrome's tracing.
#[derive(Deserialize)]
struct Event {
    #[serde(default)]
    cat: String,
    #[serde(default)]
    name: String,
    /// Microseconds.
    #[serde(default)]
    dur: f64,
    #[serde(default)]
    args: serde_json::Value,
}

/// Milliseconds a step of each kind of operator, by its name in ONNX or in the node's own domain: of `steps` steps from frame
/// to frame, the first of which does not count, the median of each node, summed over the nodes of a kind.
///
/// The record itself costs some microseconds a node. Frames take turns; three or more of one size are needed for the pyramid to
/// have one new frame a step, as in the node. The record is written into `folder`, which is made and, once it is read, removed.
pub fn profile(
    config: &Config,
    frames: &[Exposed],
    steps: usize,
    folder: &Path,
) -> Result<BTreeMap<String, f64>, Error> {
    let failed = |path: &Path| {
        let path = path.to_path_buf();
        move |error: std::io::Error| Error::Profile { path, reason: error.to_string() }
    };
    fs::create_dir_all(folder).map_err(failed(folder))?;
    let recorded = record(config, frames, steps, folder);
    let found = recorded.and_then(|files| {
        files.iter().try_fold(BTreeMap::new(), |sums, file| {
            let text = fs::read_to_string(file).map_err(failed(file))?;
            read(&text, sums).map_err(|error| Error::Profile { path: file.clone(), reason: error.to_string() })
        })
    });
    fs::remove_dir_all(folder).map_err(failed(folder))?;
    found
}

fn record(config: &Config, frames: &[Exposed], steps: usize, folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let mut matcher = Matcher::with(config, Box::new(Onnx::profiled(config, folder)?));
    let mut own = Own::default();
    for step in 0..=steps {
        let of = |number: usize| &frames[number % frames.len()];
        matcher.between(&Pair { older: of(step), newer: of(step + 1), gain_step: None }, &mut own)?;
    }
    matcher.end_profile()
}

/// Adds what a record says to the sums.
fn read(text: &str, mut sums: BTreeMap<String, f64>) -> Result<BTreeMap<String, f64>, serde_json::Error> {
    let events: Vec<Event> = serde_json::from_str(text)?;
    let mut nodes: BTreeMap<(String, String), Vec<f64>> = BTreeMap::new();
    for event in events {
        let Some(operator) = event.args.get("op_name").and_then(|name| name.as_str()) else { continue };
        if event.cat == "Node" && event.name.ends_with("_kernel_time") {
            nodes.entry((operator.to_owned(), event.name)).or_default().push(event.dur);
        }
    }
    for ((operator, _), mut took) in nodes {
        // The first step takes memory.
        took.remove(0);
        took.sort_by(f64::total_cmp);
        if let Some(median) = took.get(took.len() / 2) {
            *sums.entry(operator).or_insert(0.0) += median / 1e3;
        }
    }
    Ok(sums)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_nodes_are_summed_by_kind() {
        let event = |node: &str, kind: &str, us: u32| {
            format!(r#"{{"cat":"Node","name":"{node}_kernel_time","dur":{us},"args":{{"op_name":"{kind}"}}}}"#)
        };
        let of = |node: &str, kind: &str, took: [u32; 4]| took.map(|us| event(node, kind, us)).join(",");
        let text = format!(
            r#"[{{"cat":"Session","name":"model_run","dur":9}},{},{},{}]"#,
            of("a", "Conv", [9000, 1000, 3000, 2000]),
            of("b", "Conv", [100, 500, 500, 500]),
            of("c", "Add", [7, 1, 1, 1])
        );
        let sums = read(&text, BTreeMap::from([("Conv".to_owned(), 1.0)])).unwrap();
        assert_eq!(sums, BTreeMap::from([("Conv".to_owned(), 3.5), ("Add".to_owned(), 0.001)]));
        assert!(read("{", BTreeMap::new()).is_err());
    }
}
