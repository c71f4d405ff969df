//! What is asked to compute a graph, what really does, and of which version: ONNX Runtime falls back without a word.

use std::{
    collections::BTreeMap,
    ffi::{CStr, CString},
    os::unix::ffi::OsStrExt,
    path::Path,
    ptr, slice,
};

use ort::{
    AsPointer,
    ep::{self, ArbitrarilyConfigurableExecutionProvider, ExecutionProvider, ExecutionProviderDispatch},
    session::Session,
};

use crate::flow::{Config, Error, Precision, Provider};

/// Session setting without which the runtime does not keep the answer.
pub const RECORD: &str = "session.record_ep_graph_assignment_info";

impl Provider {
    /// All of them.
    const ALL: [Provider; 6] =
        [Provider::Cpu, Provider::OpenVino, Provider::Cuda, Provider::TensorRt, Provider::Xnnpack, Provider::Acl];

    /// What ONNX Runtime calls it.
    pub fn name(self) -> &'static str {
        match self {
            Provider::Cpu => ep::CPU::NAME,
            Provider::OpenVino => ep::OpenVINO::NAME,
            Provider::Cuda => ep::CUDA::NAME,
            Provider::TensorRt => ep::TensorRT::NAME,
            Provider::Xnnpack => ep::XNNPACK::NAME,
            Provider::Acl => ep::ACL::NAME,
        }
    }

    /// What `[flow] provider` calls it.
    fn word(self) -> String {
        format!("{self:?}").to_lowercase()
    }

    /// Whether the library that is loaded was built with it.
    fn built(self) -> bool {
        let there = match self {
            Provider::Cpu => return true,
            Provider::OpenVino => ep::OpenVINO::is_available(),
            Provider::Cuda => ep::CUDA::is_available(),
            Provider::TensorRt => ep::TensorRT::is_available(),
            Provider::Xnnpack => ep::XNNPACK::is_available(),
            Provider::Acl => ep::ACL::is_available(),
        };
        there.unwrap_or(false)
    }

    /// How to get a library that has it.
    fn remedy(self) -> &'static str {
        match self {
            Provider::Cpu => "any library has it",
            Provider::OpenVino => {
                "pip install --target /opt/openvino onnxruntime-openvino, and set [flow] runtime to the libonnxruntime.so.1.* \
                 in /opt/openvino/onnxruntime/capi"
            }
            Provider::Cuda | Provider::TensorRt => {
                "pip install --target /opt/cuda onnxruntime-gpu, and set [flow] runtime to the libonnxruntime.so.1.* in \
                 /opt/cuda/onnxruntime/capi"
            }
            Provider::Xnnpack => {
                "build ONNX Runtime with --use_xnnpack --build_shared_lib, and set [flow] runtime to it"
            }
            Provider::Acl => "build ONNX Runtime with --use_acl --build_shared_lib, and set [flow] runtime to it",
        }
    }

    /// Whether it is much faster with graphs that were opened for one size; opening takes it up to a second.
    pub fn fixes_sizes(self) -> bool {
        matches!(self, Provider::OpenVino | Provider::TensorRt)
    }

    fn precisions(self) -> &'static [Precision] {
        match self {
            Provider::Cuda | Provider::Xnnpack => &[Precision::Fp32],
            Provider::Cpu | Provider::OpenVino => &[Precision::Fp32, Precision::Bf16],
            Provider::TensorRt => &[Precision::Fp32, Precision::Bf16, Precision::Fp16],
            Provider::Acl => &[Precision::Fp32, Precision::Fp16],
        }
    }
}

/// What a session is to be given, the most wanted first; none for the runtime's own kernels alone.
pub fn wanted(config: &Config, library: &Path) -> Result<Vec<ExecutionProviderDispatch>, Error> {
    let Config { provider, precision, .. } = *config;
    let list = |words: Vec<String>| words.join(", ");
    if !provider.precisions().contains(&precision) {
        let words = provider.precisions().iter().map(|precision| format!("{precision:?}").to_lowercase());
        return Err(Error::Precision { provider: provider.word(), precision, able: list(words.collect()) });
    }
    if !provider.built() {
        let built = Provider::ALL.into_iter().filter(|provider| provider.built()).map(Provider::word);
        let (library, remedy) = (library.into(), provider.remedy());
        return Err(Error::Provider { wanted: provider.word(), library, built: list(built.collect()), remedy });
    }
    let threads = config.threads.max(1);
    let dispatches = match provider {
        Provider::Cpu => vec![],
        Provider::OpenVino => {
            // Its own words: one stream that answers soon, and never more threads than are set.
            let hint = if precision == Precision::Bf16 { "bf16" } else { "f32" };
            let settings = format!(
                r#"{{"CPU": {{"INFERENCE_PRECISION_HINT": "{hint}", "INFERENCE_NUM_THREADS": "{threads}", "NUM_STREAMS": "1", "PERFORMANCE_HINT": "LATENCY"}}}}"#
            );
            let provider = ep::OpenVINO::default().with_device_type("CPU");
            vec![provider.with_arbitrary_config("load_config", settings).build()]
        }
        // No TF32, which would be a precision that nobody asked for.
        Provider::Cuda => vec![ep::CUDA::default().with_tf32(false).build()],
        Provider::TensorRt => {
            let (fp16, bf16) = (precision == Precision::Fp16, precision == Precision::Bf16);
            let first = ep::TensorRT::default().with_fp16(fp16).with_bf16(bf16).build();
            vec![first, ep::CUDA::default().with_tf32(false).build()]
        }
        Provider::Xnnpack => {
            let threads = std::num::NonZeroUsize::new(threads).unwrap_or(std::num::NonZeroUsize::MIN);
            vec![ep::XNNPACK::default().with_intra_op_num_threads(threads).build()]
        }
        Provider::Acl => vec![ep::ACL::default().with_fast_math(precision == Precision::Fp16).build()],
    };
    Ok(dispatches.into_iter().map(ExecutionProviderDispatch::error_on_failure).collect())
}

/// Refuses a provider that was wanted and that nothing was given to.
pub fn check(config: &Config, assigned: &BTreeMap<String, usize>) -> Result<(), Error> {
    let wanted = config.provider.name();
    if assigned.contains_key(wanted) || assigned.is_empty() {
        return Ok(());
    }
    let network = config.network.clone();
    Err(Error::Unassigned { wanted: config.provider.word(), network, found: named(assigned) })
}

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
        ort::Error::result_from_status((api.Session_GetEpGraphAssignmentInfo)(session.ptr(), &mut parts, &mut count))?;
    }
    // SAFETY: on success `parts` points to `count` parts, which the session owns and keeps.
    let parts = if count == 0 { &[][..] } else { unsafe { slice::from_raw_parts(parts, count) } };
    let mut assigned = BTreeMap::new();
    for &part in parts {
        let mut name = ptr::null();
        let (mut nodes, mut count) = (ptr::null(), 0);
        // SAFETY: as above; the name is a string that ends with 0 and lives as long as the session.
        let name = unsafe {
            ort::Error::result_from_status((api.EpAssignedSubgraph_GetEpName)(part, &mut name))?;
            ort::Error::result_from_status((api.EpAssignedSubgraph_GetNodes)(part, &mut nodes, &mut count))?;
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
