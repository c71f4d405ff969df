//! The operator as ONNX Runtime sees it. It spreads the bands over the session's own threads.

use std::ops::RangeInclusive;

use ort::{
    Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use crate::flow::operators::{input, output, refusal, spread_if};

use super::{CostVolume, Inputs, Outputs, REACH_MAX, Shape, Unfit};

const NAME: &str = "CostVolume";
/// Fewer products than these are not worth waking other threads for: they take some ten microseconds.
const PRODUCTS_SPREAD_MIN: usize = 500_000;

/// The operator `nightflow::CostVolume`. If the node has a third output, that is the flow that went in, multiplied with the attribute
/// `part`.
pub struct Fused;

/// A node of a graph.
pub struct Node {
    reach: usize,
    gain: f32,
    /// What the flow is multiplied with that comes out as it went in.
    part: f32,
    /// The flow as the plain graph sees it.
    rounded: Vec<f32>,
    work: CostVolume,
}

refusal!(Unfit);

/// A flow from a cell of so many in a row or column, with the digits that a grid of −1…1 leaves it.
///
/// The plain graph's `GridSample` takes such a grid. Where nothing matches anything a network makes tenths of a thousandth
/// of a pixel of those digits, and both graphs are to give the same flow.
fn through_grid(flow: f32, cell: usize, cells: usize) -> f32 {
    let (cell, cells) = (cell as f32, cells as f32);
    let grid = (cell + flow + 0.5) * (2.0 / cells) - 1.0;
    ((grid + 1.0) * cells - 1.0) / 2.0 - cell
}

/// [`through_grid`] for 2 planes of rows of `width`, right and down.
fn round(flow: &[f32], width: usize, rounded: &mut Vec<f32>) {
    let cells = flow.len() / 2;
    let height = cells / width;
    rounded.resize(flow.len(), 0.0);
    let (right, down) = rounded.split_at_mut(cells);
    for (to, from) in right.chunks_exact_mut(width).zip(flow.chunks_exact(width)) {
        to.iter_mut().zip(from).enumerate().for_each(|(x, (to, u))| *to = through_grid(*u, x, width));
    }
    for (y, (to, from)) in down.chunks_exact_mut(width).zip(flow[cells..].chunks_exact(width)).enumerate() {
        to.iter_mut().zip(from).for_each(|(to, v)| *to = through_grid(*v, y, height));
    }
}

fn reach(attribute: Option<i64>) -> Result<usize> {
    let reach = attribute.and_then(|reach| usize::try_from(reach).ok()).filter(|reach| *reach <= REACH_MAX);
    reach.ok_or_else(|| Error::new(format!("CostVolume: reach should be 0 to {REACH_MAX}, it is {attribute:?}")))
}

impl Operator for Fused {
    type Kernel<'attr> = Node;

    fn name(&self) -> &str {
        NAME
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::required(TensorElementType::Float32) }; 4]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        let required = [const { OperatorOutput::required(TensorElementType::Float32) }; 2];
        required.into_iter().chain([OperatorOutput::optional(TensorElementType::Float32)])
    }

    fn create_kernel<'attr>(&self, attributes: &KernelContext<'attr>) -> Result<Node> {
        let gain = attributes.get("gain").unwrap_or(1.0f32);
        if !gain.is_normal() {
            return Err(Error::new(format!("CostVolume: gain should be finite and not zero, it is {gain}")));
        }
        let part = attributes.get("part").unwrap_or(1.0);
        Ok(Node { reach: reach(attributes.get("reach"))?, gain, part, rounded: vec![], work: CostVolume::default() })
    }
}

impl Kernel for Node {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (older, lengths) = input(context, NAME, 0)?;
        let [1, channels, height, width] = *lengths else {
            return Err(Error::new(format!("CostVolume: older should be [1, C, H, W], it is {lengths:?}")));
        };
        let [channels, height, width] = [channels, height, width].map(|length| usize::try_from(length).unwrap_or(0));
        let (newer, lengths_newer) = input(context, NAME, 1)?;
        let (flow, lengths_flow) = input(context, NAME, 2)?;
        let (sharpness, _) = input(context, NAME, 3)?;
        if lengths_newer != lengths || lengths_flow != [1, 2, lengths[2], lengths[3]] || sharpness.len() != 1 {
            let found = format!("{lengths_newer:?}, {lengths_flow:?} and {} values", sharpness.len());
            return Err(Error::new(format!("CostVolume: newer, flow and sharpness don't fit {lengths:?}: {found}")));
        }
        let shape = Shape { channels, height, width, reach: self.reach };
        round(flow, width.max(1), &mut self.rounded);
        let inputs = Inputs { older, newer, flow: &self.rounded, sharpness: sharpness[0], gain: self.gain };
        let volume = output(context, 0, [1, shape.displacements() as i64, lengths[2], lengths[3]])?;
        let argmax = output(context, 1, [1, 2, lengths[2], lengths[3]])?;
        if context.num_outputs()? > 2 {
            let to = output(context, 2, [1, 2, lengths[2], lengths[3]])?;
            to.iter_mut().zip(flow).for_each(|(to, flow)| *to = self.part * flow);
        }
        let products = shape.cells().saturating_mul(channels).saturating_mul(shape.displacements());
        self.work.compute(shape, &inputs, Outputs { volume, argmax }, |count, work| {
            spread_if(products >= PRODUCTS_SPREAD_MIN, context, count, work)
        })
    }
}
