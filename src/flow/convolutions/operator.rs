//! The operators as ONNX Runtime sees them. They spread their bands over the session's own threads.

use std::ops::RangeInclusive;

use ort::{
    Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use super::{CONVOLUTIONS, Chain, Encoder, Layer, Narrow, Step, Unit, View, Weights, Wide, chain, encoder};
use crate::flow::{
    onnx_shared,
    operators::{input, output, refusal, spread_if},
    winograd,
};

const CHAIN: &str = "Convolutions";
const ENCODER: &str = "Encoder";
/// Smaller pictures than this are not worth waking other threads for, in 16 bits and in 32.
const CELLS_SPREAD_MIN: usize = 512;
const CELLS_SPREAD_MIN_WIDE: usize = 16;
/// The most tensors that are read as one.
const PARTS_MAX: usize = 8;
/// The farthest apart that weights may lie.
const DILATION_MAX: i64 = 64;

refusal!(chain::Unfit);
refusal!(encoder::Unfit);

/// `nightflow::Convolutions(part [1, C, H, W] …, weight [O, I, K, K], bias [O] …)`: the parts are read as if they were
/// concatenated; each weight and bias is a layer that keeps the size. Attributes: how many `parts`, and for each layer one of
/// `dilations` and of `slopes`, what negative results are multiplied with; of how many `bits` the factors are, 16 (bf16) or
/// 32, then for weights of 3 × 3 alone; and whether the layers are `dense`: then each reads the parts and all that layers before it
/// gave, in this order. Outputs: the last layer's and the one before's.
pub struct Convolutions;

/// `nightflow::Encoder(image [1, 3, H, W], weight, bias …)`: RAFT-small's feature encoder, convolutions in the order in which
/// they are used, then two projections of 1 × 1. Attributes: how the image is seen, by `factor`, `offset` and an even `shift`, as it
/// is where they are missing; `slopes`, what the projections multiply negative results with, 1 where they are missing; and of how
/// many `bits` the factors are, 16 (bf16) or 32.
/// Outputs: what is projected from the second layer's, what the last convolution gives, and what is projected from that.
pub struct Encode;

/// A node of a graph.
pub struct ChainNode {
    parts: usize,
    work: Work,
}

/// By the bits of the factors.
enum Work {
    Sixteen(Chain),
    ThirtyTwo(winograd::Chain),
}

/// A node of a graph.
pub struct EncoderNode {
    work: Encoding,
}

/// By the bits of the factors.
enum Encoding {
    Sixteen(Box<Encoder<Narrow>>),
    ThirtyTwo(Box<Encoder<Wide>>),
}

/// An input that does not change, and its shape.
fn constant<'a>(attributes: &KernelContext<'a>, operator: &str, index: usize) -> Result<(Vec<usize>, Vec<f32>)> {
    let value = attributes.constant_input::<ort::value::TensorValueType<f32>>(index);
    let value = value.map_err(|e| Error::new(format!("{operator}: input {index} should be a constant: {e}")))?;
    let (shape, values) = value.try_extract_tensor::<f32>()?;
    Ok((shape.iter().map(|length| usize::try_from(*length).unwrap_or(0)).collect(), values.to_vec()))
}

/// A weight [O, I, rows, columns] and its bias.
fn layer(attributes: &KernelContext<'_>, operator: &str, index: usize) -> Result<([usize; 4], Vec<f32>, Vec<f32>)> {
    let (shape, weights) = constant(attributes, operator, index)?;
    let (_, bias) = constant(attributes, operator, index + 1)?;
    let wrong =
        || Error::new(format!("{operator}: inputs {index} and {} are no weight and bias: {shape:?}", index + 1));
    let shape: [usize; 4] = shape[..].try_into().map_err(|_| wrong())?;
    let [outputs, inputs, rows, columns] = shape;
    let sound = bias.len() == outputs && inputs > 0 && outputs > 0 && rows % 2 == 1 && columns % 2 == 1;
    if sound { Ok((shape, weights, bias)) } else { Err(wrong()) }
}

impl Operator for Convolutions {
    type Kernel<'attr> = ChainNode;

    fn name(&self) -> &str {
        CHAIN
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::variadic(3).homogenous(TensorElementType::Float32) }]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [OperatorOutput::required(TensorElementType::Float32), OperatorOutput::optional(TensorElementType::Float32)]
    }

    fn create_kernel<'attr>(&self, attributes: &KernelContext<'attr>) -> Result<ChainNode> {
        let dilations: Vec<i64> = attributes.get("dilations").unwrap_or_default();
        let slopes: Vec<f32> = attributes.get("slopes").unwrap_or_default();
        let parts: i64 = attributes.get("parts").unwrap_or(0);
        let (inputs, outputs) = (attributes.inputs()?.len(), attributes.outputs()?.len());
        let parts = usize::try_from(parts).unwrap_or(0);
        let fits = inputs == parts + 2 * slopes.len() && dilations.len() == slopes.len() && slopes.len() >= outputs;
        let within = |range: bool| fits && (1..=PARTS_MAX).contains(&parts) && outputs > 0 && range;
        let sound =
            dilations.iter().all(|d| (1..=DILATION_MAX).contains(d)) && slopes.iter().all(|s| (0.0..=1.0).contains(s));
        if !within(sound) {
            let found = format!("{inputs} inputs, {outputs} outputs, {parts} parts, {dilations:?}, {slopes:?}");
            return Err(Error::new(format!("{CHAIN}: parts, dilations and slopes don't fit: {found}")));
        }
        let bits: i64 = attributes.get("bits").unwrap_or(16);
        let dense = attributes.get::<i64>("dense").unwrap_or(0) != 0;
        // Channels of all that there is to be read.
        let (mut narrow, mut wide, mut channels) = (vec![], vec![], vec![]);
        for (number, (dilation, slope)) in dilations.into_iter().zip(slopes).enumerate() {
            let (shape, weights, bias) = layer(attributes, CHAIN, parts + 2 * number)?;
            if channels.is_empty() {
                channels.push(shape[1]);
            }
            let read = if dense { &channels[..] } else { &channels[number..] };
            if read.iter().sum::<usize>() != shape[1] {
                return Err(Error::new(format!(
                    "{CHAIN}: layer {number} should read {read:?} channels, it is {shape:?}"
                )));
            }
            let dilation = dilation as usize;
            match (bits, shape) {
                (16, _) => {
                    let step = Step { stride: [1; 2], dilation, slope };
                    narrow.push(Layer::of_maps(&weights, shape, read, &bias, step));
                }
                (32, [outputs, _, 3, 3]) => {
                    let unit = winograd::Unit::best();
                    let mut layer = winograd::Layer::new(unit, &weights, (outputs, read), &bias, dilation, slope);
                    layer.share(onnx_shared::first);
                    wide.push(layer);
                }
                _ => {
                    let found = format!("layer {number} has {bits} and {shape:?}");
                    return Err(Error::new(format!("{CHAIN}: bits should be 16, or 32 for weights of 3 × 3: {found}")));
                }
            }
            channels.push(shape[0]);
        }
        let work = match bits {
            32 => Work::ThirtyTwo(winograd::Chain::new(winograd::Unit::best(), wide, dense)),
            _ => Work::Sixteen(Chain::new(Unit::best(), narrow, dense)),
        };
        Ok(ChainNode { parts, work })
    }
}

/// Rows and columns of a tensor of one picture.
fn size(lengths: &[i64]) -> Option<[usize; 2]> {
    let [1, _, height, width] = *lengths else { return None };
    Some([usize::try_from(height).ok()?, usize::try_from(width).ok()?])
}

impl Kernel for ChainNode {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (first, lengths) = input(context, CHAIN, 0)?;
        let wrong = |lengths: &[i64]| {
            Error::new(format!("{CHAIN}: parts should be [1, C, H, W] of one size, one is {lengths:?}"))
        };
        let [height, width] = size(lengths).ok_or_else(|| wrong(lengths))?;
        let mut parts = [first; PARTS_MAX];
        for (index, part) in parts.iter_mut().enumerate().take(self.parts) {
            let (values, lengths) = input(context, CHAIN, index)?;
            if size(lengths) != Some([height, width]) {
                return Err(wrong(lengths));
            }
            *part = values;
        }
        let [outputs, kept] = match &self.work {
            Work::Sixteen(chain) => chain.outputs(),
            Work::ThirtyTwo(chain) => chain.outputs(),
        };
        let of = |channels: usize| [1, channels as i64, height as i64, width as i64];
        let last = output(context, 0, of(outputs))?;
        let before = if context.num_outputs()? > 1 { Some(output(context, 1, of(kept))?) } else { None };
        let cells = height * width;
        let least = match self.work {
            Work::Sixteen(_) => CELLS_SPREAD_MIN,
            Work::ThirtyTwo(_) => CELLS_SPREAD_MIN_WIDE,
        };
        let spread = |count: usize, work: &(dyn Fn(usize) + Sync)| spread_if(cells >= least, context, count, work);
        let parts = &parts[..self.parts];
        match &mut self.work {
            Work::Sixteen(chain) => chain.run(parts, [height, width], last, before, &spread),
            Work::ThirtyTwo(chain) => chain.run(parts, [height, width], last, before, &spread),
        }
    }
}

impl Operator for Encode {
    type Kernel<'attr> = EncoderNode;

    fn name(&self) -> &str {
        ENCODER
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::variadic(1 + 2 * CONVOLUTIONS).homogenous(TensorElementType::Float32) }]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [const { OperatorOutput::required(TensorElementType::Float32) }; 3]
    }

    fn create_kernel<'attr>(&self, attributes: &KernelContext<'attr>) -> Result<EncoderNode> {
        let inputs = attributes.inputs()?.len();
        if inputs != 1 + 2 * CONVOLUTIONS {
            return Err(Error::new(format!(
                "{ENCODER}: {} inputs are needed, there are {inputs}",
                1 + 2 * CONVOLUTIONS
            )));
        }
        let layers = (0..CONVOLUTIONS).map(|number| layer(attributes, ENCODER, 1 + 2 * number));
        let layers = layers.collect::<Result<Vec<_>>>()?;
        let slopes: Vec<f32> = attributes.get("slopes").unwrap_or(vec![1.0; 2]);
        if slopes.len() != 2 || slopes.iter().any(|slope| !(0.0..=1.0).contains(slope)) {
            return Err(Error::new(format!("{ENCODER}: slopes should be two numbers of 0 to 1, they are {slopes:?}")));
        }
        let slope = |number: usize| (number + 2).checked_sub(CONVOLUTIONS).map_or(1.0, |projection| slopes[projection]);
        let weights = layers.iter().enumerate();
        let weights: Vec<Weights<'_>> = weights
            .map(|(number, (shape, values, bias))| Weights { values, shape: *shape, bias, slope: slope(number) })
            .collect();
        let shift: i64 = attributes.get("shift").unwrap_or(0);
        let shift = usize::try_from(shift).ok().filter(|shift| shift.is_multiple_of(2));
        let shift = shift.ok_or_else(|| Error::new(format!("{ENCODER}: shift should be an even number of pixels")))?;
        let (factor, offset) = (attributes.get("factor").unwrap_or(1.0), attributes.get("offset").unwrap_or(0.0));
        let view = View { factor, offset, shift };
        let work = match attributes.get::<i64>("bits").unwrap_or(16) {
            16 => Encoding::Sixteen(Box::new(Encoder::new(Unit::best(), view, &weights)?)),
            32 => Encoding::ThirtyTwo(Box::new(Encoder::new(winograd::Unit::best(), view, &weights)?)),
            bits => return Err(Error::new(format!("{ENCODER}: bits should be 16 or 32, they are {bits}"))),
        };
        Ok(EncoderNode { work })
    }
}

impl Kernel for EncoderNode {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (image, lengths) = input(context, ENCODER, 0)?;
        let wrong = || Error::new(format!("{ENCODER}: image should be [1, 3, H, W], it is {lengths:?}"));
        let [height, width] = size(lengths).ok_or_else(wrong)?;
        let channels = match &self.work {
            Encoding::Sixteen(encoder) => encoder.outputs(),
            Encoding::ThirtyTwo(encoder) => encoder.outputs(),
        };
        let of = |channels: usize, part: usize| [1, channels, height / part, width / part].map(|length| length as i64);
        let quarter = output(context, 0, of(channels[0], 4))?;
        let eighth = output(context, 1, of(channels[1], 8))?;
        let projected = output(context, 2, of(channels[2], 8))?;
        let spread = |count: usize, work: &(dyn Fn(usize) + Sync)| {
            spread_if(height * width >= CELLS_SPREAD_MIN, context, count, work)
        };
        let to = [quarter, eighth, projected];
        match &mut self.work {
            Encoding::Sixteen(encoder) => encoder.run(image, [height, width], to, &spread),
            Encoding::ThirtyTwo(encoder) => encoder.run(image, [height, width], to, &spread),
        }
    }
}
