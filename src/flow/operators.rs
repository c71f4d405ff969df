//! What the node's own operators in ONNX graphs share: their domain, and how they get at tensors and threads without memory.

use std::{
    ffi::c_void,
    ptr::{self, NonNull},
    slice,
};

use ort::{
    AsPointer, Error, Result,
    operator::{ComputeContext, OperatorDomain},
};

use crate::flow::{convolutions, cost_volume, moved, normalised, resized};

/// What a session needs to run graphs with them.
pub fn domain() -> Result<OperatorDomain> {
    let domain = OperatorDomain::new("nightflow")?.add(cost_volume::Fused)?.add(normalised::Normalise)?;
    let domain = domain.add(convolutions::Convolutions)?.add(convolutions::Encode)?;
    domain.add(resized::Resized)?.add(moved::Moved)
}

/// What an operator refuses is an error of ONNX Runtime's; in tests of what fits there is none.
macro_rules! refusal {
    ($unfit:ty) => {
        impl From<$unfit> for ort::Error {
            fn from(unfit: $unfit) -> Self {
                Self::new(unfit.to_string())
            }
        }

        #[cfg(test)]
        impl From<$unfit> for std::convert::Infallible {
            fn from(unfit: $unfit) -> Self {
                panic!("{unfit}")
            }
        }
    };
}
pub(super) use refusal;

/// An input's values and lengths. Neither takes memory, which `ComputeContext::input` does.
pub fn input<'a>(context: &'a ComputeContext, operator: &str, index: usize) -> Result<(&'a [f32], &'a [i64])> {
    let api = ort::api();
    let mut value = ptr::null();
    // SAFETY: the context lives for the call of the kernel, the place is ours to write to.
    unsafe { Error::result_from_status((api.KernelContext_GetInput)(context.ptr(), index, &mut value))? };
    let mut kind = ort::sys::ONNXTensorElementDataType::ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
    let (mut lengths, mut count, mut data) = (ptr::null(), 0, ptr::null());
    if value.is_null() {
        return Err(Error::new(format!("{operator}: there is no input {index}")));
    }
    // SAFETY: the value is an input of this node and lives as long as the context.
    unsafe {
        let shape = (api.GetTensorElementTypeAndShapeDataReference)(value, &mut kind, &mut lengths, &mut count);
        Error::result_from_status(shape)?;
        Error::result_from_status((api.GetTensorData)(value, &mut data))?;
    }
    if kind != ort::sys::ONNXTensorElementDataType::ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT {
        return Err(Error::new(format!("{operator}: input {index} should be of 32-bit floats, it is {kind:?}")));
    }
    // SAFETY: so many lengths were just said to be there.
    let lengths = if count == 0 { &[][..] } else { unsafe { slice::from_raw_parts(lengths, count) } };
    let values = lengths.iter().product::<i64>() as usize;
    // SAFETY: a tensor of floats has as many of them as its lengths say, and nobody writes to an input.
    Ok((if values == 0 { &[] } else { unsafe { slice::from_raw_parts(data.cast(), values) } }, lengths))
}

/// Memory of an output, which is asked for once only.
// The context owns what comes back, and it can't be borrowed for writing: several outputs are written at once.
#[allow(clippy::mut_from_ref)]
pub fn output(context: &ComputeContext, index: usize, lengths: [i64; 4]) -> Result<&mut [f32]> {
    let api = ort::api();
    let (mut value, mut data) = (ptr::null_mut(), ptr::null_mut());
    // SAFETY: the context lives for the call of the kernel, the places are ours to write to, and the value is an output of
    // this node, of the type that `Operator::outputs` names.
    unsafe {
        let (context, count) = (context.ptr().cast_mut(), lengths.len());
        let status = (api.KernelContext_GetOutput)(context, index, lengths.as_ptr(), count, &mut value);
        Error::result_from_status(status)?;
        Error::result_from_status((api.GetTensorMutableData)(value, &mut data))?;
    }
    let start = NonNull::new(data.cast()).unwrap_or(NonNull::dangling());
    // SAFETY: an output has room for what its lengths say, and it is asked for once in a call, so that nobody else has it.
    Ok(unsafe { slice::from_raw_parts_mut(start.as_ptr(), lengths.iter().product::<i64>() as usize) })
}

/// Calls `work` with 0 to `count` − 1 on the threads of the session. Unlike `ComputeContext::par_for` it takes no memory.
pub fn spread(context: &ComputeContext, count: usize, work: &(dyn Fn(usize) + Sync)) -> Result<()> {
    unsafe extern "C" fn call(work: *mut c_void, number: usize) {
        // SAFETY: it is the address of `work` below, which outlives the call of `KernelContext_ParallelFor`.
        let work = unsafe { *work.cast::<&(dyn Fn(usize) + Sync)>() };
        work(number);
    }
    let address = (&raw const work).cast_mut().cast();
    // SAFETY: `call` reads what the address points to as what it is, and ONNX Runtime comes back when every call has.
    unsafe {
        // As many batches as bands: who is done takes the next.
        let status = (ort::api().KernelContext_ParallelFor)(context.ptr(), call, count, count, address);
        Error::result_from_status(status)
    }
}

/// [`spread`] where that pays, else one after the other.
pub fn spread_if(pays: bool, context: &ComputeContext, count: usize, work: &(dyn Fn(usize) + Sync)) -> Result<()> {
    if pays {
        return spread(context, count, work);
    }
    (0..count).for_each(work);
    Ok(())
}
