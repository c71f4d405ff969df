//! Where the ONNX Runtime library is looked for, and what is said when it is not found.
//!
//! `[flow] runtime`, then `ORT_DYLIB_PATH`: where one of them names a file, only that file is taken, for whoever named
//! it wants to know that it does not load. Else beside the executable, in the folder above it, and where the build put it.

use std::{
    fmt,
    path::{Path, PathBuf},
};

const FILE: &str = "libonnxruntime.so";

/// The version that the build fetches and that the tests run with; 1.24 is the oldest that loads.
pub const VERSION: &str = env!("NIGHTFLOW_RUNTIME_VERSION");

/// A place to look at.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Who says so.
    pub named_by: &'static str,
    /// The library.
    pub path: PathBuf,
}

/// A place that did not do, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tried {
    /// Where.
    pub place: Place,
    /// Why not.
    pub reason: String,
}

impl fmt::Display for Tried {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "\n  {} ({}): {}", self.place.path.display(), self.place.named_by, self.reason)
    }
}

/// Every place to look at, in order. `set` is `[flow] runtime`, `variable` is what `ORT_DYLIB_PATH` holds.
pub fn places(set: &Path, variable: Option<PathBuf>, executable: Option<&Path>) -> Vec<Place> {
    if !set.as_os_str().is_empty() {
        return vec![Place { named_by: "[flow] runtime", path: set.to_path_buf() }];
    }
    if let Some(path) = variable.filter(|path| !path.as_os_str().is_empty()) {
        return vec![Place { named_by: "ORT_DYLIB_PATH", path }];
    }
    let mut places = Vec::new();
    let names = ["beside the executable", "above the executable"];
    for (named_by, folder) in names.into_iter().zip(executable.into_iter().flat_map(|path| path.ancestors().skip(1))) {
        places.push(Place { named_by, path: folder.join(FILE) });
    }
    places.push(Place { named_by: "put there by the build", path: env!("NIGHTFLOW_RUNTIME").into() });
    places
}

/// What to do about a missing library, in a line.
pub fn remedy() -> String {
    format!(
        "pip install --no-deps --target /opt/onnxruntime onnxruntime=={VERSION}, and set [flow] runtime or \
         ORT_DYLIB_PATH to /opt/onnxruntime/onnxruntime/capi/libonnxruntime.so.{VERSION}"
    )
}
