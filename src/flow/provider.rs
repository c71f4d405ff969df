//! What really computes a graph, and of which version: ONNX Runtime is asked, for it falls back to another provider without a word.

use std::{
    collections::BTreeMap,
    ffi::{CStr, CString},
    os::unix::ffi::OsStrExt,
    path::Path,
    ptr, slice,
};

use ort::{AsPointer, Error, session::Session};

/// Session setting without which the runtime does not keep the answer.
pub const RECORD: &str = "session.record_ep_graph_assignment_info";

/// The version of a library that is loaded.
pub fn version(library: &Path) -> String {
    type GetApiBase = unsafe extern "C" fn() -> *const ort::sys::OrtApiBase;
    let unknown = || "of an unknown version".to_string();
    let Ok(path) = CString::new(library.as_os_str().as_bytes()) else { return unknown() };
    // SAFETY: both strings end with 0; the library is loaded already and stays so, for `ort` never lets it go, so the
    // handle is not closed; the symbol has this type in every version, and its answer lives as long as the library.
    unsafe {
        let handle = libc::dlopen(path.as_ptr(), libc::RTLD_LAZY | libc::RTLD_NOLOAD);
        if handle.is_null() {
            return unknown();
        }
        let symbol = libc::dlsym(handle, c"OrtGetApiBase".as_ptr());
        if symbol.is_null() {
            return unknown();
        }
        let base = std::mem::transmute::<*mut libc::c_void, GetApiBase>(symbol)();
        CStr::from_ptr(((*base).GetVersionString)()).to_string_lossy().into_owned()
    }
}

/// How many nodes of the graph each execution provider was given, by the provider's name.
pub fn assigned(session: &Session) -> ort::Result<BTreeMap<String, usize>> {
    let api = ort::api();
    let (mut parts, mut count) = (ptr::null(), 0);
    // SAFETY: the session is alive, both places are ours to write to, and the status goes to `result_from_status`.
    unsafe {
        Error::result_from_status((api.Session_GetEpGraphAssignmentInfo)(session.ptr(), &mut parts, &mut count))?;
    }
    // SAFETY: on success `parts` points to `count` parts, which the session owns and keeps.
    let parts = if count == 0 { &[][..] } else { unsafe { slice::from_raw_parts(parts, count) } };
    let mut assigned = BTreeMap::new();
    for &part in parts {
        let mut name = ptr::null();
        let (mut nodes, mut count) = (ptr::null(), 0);
        // SAFETY: as above; the name is a string that ends with 0 and lives as long as the session.
        let name = unsafe {
            Error::result_from_status((api.EpAssignedSubgraph_GetEpName)(part, &mut name))?;
            Error::result_from_status((api.EpAssignedSubgraph_GetNodes)(part, &mut nodes, &mut count))?;
            CStr::from_ptr(name).to_string_lossy().into_owned()
        };
        *assigned.entry(name).or_insert(0) += count;
    }
    Ok(assigned)
}

/// The same in words: the name alone where one provider computes everything.
pub fn named(assigned: &BTreeMap<String, usize>) -> String {
    match assigned.len() {
        0 => "an execution provider that the runtime does not name".into(),
        1 => assigned.keys().cloned().collect(),
        _ => {
            let all: usize = assigned.values().sum();
            let part = |(name, count): (&String, &usize)| format!("{name} ({count} of {all} nodes)");
            assigned.iter().map(part).collect::<Vec<_>>().join(", ")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fall_back_is_seen() {
        let two = BTreeMap::from([("CPUExecutionProvider".into(), 3), ("XnnpackExecutionProvider".into(), 97)]);
        assert_eq!(named(&two), "CPUExecutionProvider (3 of 100 nodes), XnnpackExecutionProvider (97 of 100 nodes)");
    }
}
