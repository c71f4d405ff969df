//! The operator as ONNX Runtime sees it. It spreads the bands over the session's own threads.

use std::{
    ffi::c_void,
    ops::RangeInclusive,
    ptr::{self, NonNull},
    slice,
};

use ort::{
    AsPointer, Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorDomain, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use super::{CostVolume, Inputs, Outputs, REACH_MAX, Shape, Unfit};

/// Fewer products than these are not worth waking other threads for: they take some ten microseconds.
const PRODUCTS_SPREAD_MIN: usize = 500_000;

/// What a session needs to run fused graphs.
pub fn domain() -> Result<OperatorDomain> {
    OperatorDomain::new("nightflow")?.add(Fused)
}

struct Fused;

/// A node of a graph.
struct Node {
    reach: usize,
    gain: f32,
    work: CostVolume,
}

impl From<Unfit> for Error {
    fn from(unfit: Unfit) -> Self {
        Error::new(unfit.to_string())
    }
}

fn reach(attribute: Option<i64>) -> Result<usize> {
    let reach = attribute.and_then(|reach| usize::try_from(reach).ok()).filter(|reach| *reach <= REACH_MAX);
    reach.ok_or_else(|| Error::new(format!("CostVolume: reach should be 0 to {REACH_MAX}, it is {attribute:?}")))
}

impl Operator for Fused {
    type Kernel<'attr> = Node;

    fn name(&self) -> &str {
        "CostVolume"
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::required(TensorElementType::Float32) }; 4]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [const { OperatorOutput::required(TensorElementType::Float32) }; 2]
    }

    fn create_kernel<'attr>(&self, attributes: &KernelContext<'attr>) -> Result<Node> {
        let gain = attributes.get("gain").unwrap_or(1.0f32);
        if !gain.is_normal() {
            return Err(Error::new(format!("CostVolume: gain should be finite and not zero, it is {gain}")));
        }
        Ok(Node { reach: reach(attributes.get("reach"))?, gain, work: CostVolume::default() })
    }
}

impl Kernel for Node {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (older, lengths) = input(context, 0)?;
        let [1, channels, height, width] = *lengths else {
            return Err(Error::new(format!("CostVolume: older should be [1, C, H, W], it is {lengths:?}")));
        };
        let [channels, height, width] = [channels, height, width].map(|length| usize::try_from(length).unwrap_or(0));
        let (newer, lengths_newer) = input(context, 1)?;
        let (flow, lengths_flow) = input(context, 2)?;
        let (sharpness, _) = input(context, 3)?;
        if lengths_newer != lengths || lengths_flow != [1, 2, lengths[2], lengths[3]] || sharpness.len() != 1 {
            let found = format!("{lengths_newer:?}, {lengths_flow:?} and {} values", sharpness.len());
            return Err(Error::new(format!("CostVolume: newer, flow and sharpness don't fit {lengths:?}: {found}")));
        }
        let shape = Shape { channels, height, width, reach: self.reach };
        let inputs = Inputs { older, newer, flow, sharpness: sharpness[0], gain: self.gain };
        let volume = output(context, 0, [1, shape.displacements() as i64, lengths[2], lengths[3]])?;
        let argmax = output(context, 1, [1, 2, lengths[2], lengths[3]])?;
        let products = shape.cells().saturating_mul(channels).saturating_mul(shape.displacements());
        self.work.compute(shape, &inputs, Outputs { volume, argmax }, |count, work| {
            if products < PRODUCTS_SPREAD_MIN {
                (0..count).for_each(work);
                return Ok(());
            }
            spread(context, count, work)
        })
    }
}

/// An input's values and lengths. Neither takes memory, which `ComputeContext::input` does.
fn input(context: &ComputeContext, index: usize) -> Result<(&[f32], &[i64])> {
    let api = ort::api();
    let mut value = ptr::null();
    // SAFETY: the context lives for the call of the kernel, the place is ours to write to.
    unsafe { Error::result_from_status((api.KernelContext_GetInput)(context.ptr(), index, &mut value))? };
    let mut kind = ort::sys::ONNXTensorElementDataType::ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
    let (mut lengths, mut count, mut data) = (ptr::null(), 0, ptr::null());
    if value.is_null() {
        return Err(Error::new(format!("CostVolume: there is no input {index}")));
    }
    // SAFETY: the value is an input of this node and lives as long as the context.
    unsafe {
        let shape = (api.GetTensorElementTypeAndShapeDataReference)(value, &mut kind, &mut lengths, &mut count);
        Error::result_from_status(shape)?;
        Error::result_from_status((api.GetTensorData)(value, &mut data))?;
    }
    if kind != ort::sys::ONNXTensorElementDataType::ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT {
        return Err(Error::new(format!("CostVolume: input {index} should be of 32-bit floats, it is {kind:?}")));
    }
    // SAFETY: so many lengths were just said to be there.
    let lengths = if count == 0 { &[][..] } else { unsafe { slice::from_raw_parts(lengths, count) } };
    let values = lengths.iter().product::<i64>() as usize;
    // SAFETY: a tensor of floats has as many of them as its lengths say, and nobody writes to an input.
    Ok((if values == 0 { &[] } else { unsafe { slice::from_raw_parts(data.cast(), values) } }, lengths))
}

/// Memory of an output, which is asked for once only.
// The context owns what comes back, and it can't be borrowed for writing: both outputs are written at once.
#[allow(clippy::mut_from_ref)]
fn output(context: &ComputeContext, index: usize, lengths: [i64; 4]) -> Result<&mut [f32]> {
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
fn spread(context: &ComputeContext, count: usize, work: &(dyn Fn(usize) + Sync)) -> Result<()> {
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
