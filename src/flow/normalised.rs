//! The operator `nightflow::Normalised`: features made comparable, so that their products are close to a cosine.
//!
//! Each channel is centred and brought to a deviation of one over the frame, then each pixel's vector of C channels:
//!
//! - s(c, p) = (x(c, p) − mean of x(c)) / √(variance of x(c) + 10⁻⁶);
//! - y(c, p) = s(c, p) / √(1 / C · Σ s(c, p)² + 0.05), the sum being over the channels.
//!
//! In ONNX's own operators that is ten passes over the features. Every result is computed by one thread in a fixed order, so
//! that it does not depend on how many threads there are.

use std::ops::RangeInclusive;

use ort::{
    Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use super::{
    bands::{Band, Bands},
    convolutions::Spread,
    lanes::{Lanes, Unit, Work},
    operators::{input, output, refusal, spread},
};

const NAME: &str = "Normalised";
/// Added to a channel's variance.
const OF_CHANNEL: f64 = 1e-6;
/// Added to the mean square of a pixel's channels: a flat neighbourhood keeps a short vector.
const OF_PIXEL: f32 = 0.05;
/// About how many bands there are.
const BANDS: usize = 8;
/// Sums that run beside each other, so that they need not wait for each other.
const SUMS: usize = 32;

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("features of {channels} × {height} × {width} can't have {found:?} values in and out")]
pub struct Unfit {
    channels: usize,
    height: usize,
    width: usize,
    found: [usize; 2],
}

/// The operator with its memory, which is taken at the first call of a size.
#[derive(Debug, Default)]
pub struct Normalised {
    /// Of each channel what is subtracted, and what is multiplied with then.
    norms: Vec<[f32; 2]>,
    /// For each band sums of a row.
    rows: Vec<f32>,
}

impl Normalised {
    /// Computes everything: `from` and `to` are channels × height × width.
    pub fn run<E: From<Unfit>>(
        &mut self,
        from: &[f32],
        [channels, height, width]: [usize; 3],
        to: &mut [f32],
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let cells = height * width;
        if channels * cells == 0 || [from.len(), to.len()] != [channels * cells; 2] {
            return Err(Unfit { channels, height, width, found: [from.len(), to.len()] }.into());
        }
        let unit = Unit::best();
        self.norms.resize(channels, [0.0; 2]);
        let each = channels.div_ceil(BANDS);
        let norms = Bands::new(&mut self.norms, [1, channels, 1], each);
        spread(channels.div_ceil(each), &|number| {
            if let Some(norms) = norms.take(number) {
                unit.run(Channels { from, cells, norms });
            }
        })?;
        let each = height.div_ceil(BANDS);
        let bands = height.div_ceil(each);
        self.rows.resize(bands * width, 0.0);
        let (to, rows) =
            (Bands::new(to, [channels, height, width], each), Bands::new(&mut self.rows, [1, bands, width], 1));
        let norms = &self.norms[..];
        spread(bands, &|number| {
            if let (Some(to), Some(sums)) = (to.take(number), rows.take(number)) {
                unit.run(Pixels { from, cells, width, norms, number, sums, to });
            }
        })
    }
}

/// Means and deviations of some channels.
struct Channels<'a> {
    from: &'a [f32],
    cells: usize,
    norms: Band<'a, [f32; 2]>,
}

/// Σ f(value). Partial sums are of 32 bits, as many values in each as a row has lines.
#[inline(always)]
fn summed(plane: &[f32], of: impl Fn(f32) -> f32) -> f64 {
    let mut total = 0.0;
    for block in plane.chunks(64 * SUMS) {
        let mut sums = [0.0f32; SUMS];
        let (lines, rest) = block.as_chunks::<SUMS>();
        for line in lines {
            for (sum, value) in sums.iter_mut().zip(line) {
                *sum += of(*value);
            }
        }
        let rest: f64 = rest.iter().map(|value| f64::from(of(*value))).sum();
        total += sums.iter().map(|sum| f64::from(*sum)).sum::<f64>() + rest;
    }
    total
}

impl Work for Channels<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, _: L) {
        for channel in self.norms.first..self.norms.end {
            let plane = &self.from[channel * self.cells..][..self.cells];
            let mean = (summed(plane, |value| value) / self.cells as f64) as f32;
            let variance = summed(plane, |value| (value - mean) * (value - mean)) / self.cells as f64;
            self.norms.row(0, channel)[0] = [mean, (variance + OF_CHANNEL).sqrt().recip() as f32];
        }
    }
}

/// Some rows of every channel.
struct Pixels<'a> {
    from: &'a [f32],
    cells: usize,
    width: usize,
    norms: &'a [[f32; 2]],
    number: usize,
    sums: Band<'a, f32>,
    to: Band<'a, f32>,
}

impl Work for Pixels<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, _: L) {
        let Self { from, cells, width, norms, number, .. } = self;
        let sums = self.sums.row(0, number);
        for y in self.to.first..self.to.end {
            sums.fill(0.0);
            for (channel, [mean, scale]) in norms.iter().enumerate() {
                let row = &from[channel * cells + y * width..][..width];
                for ((to, sum), value) in self.to.row(channel, y).iter_mut().zip(&mut *sums).zip(row) {
                    let scaled = (value - mean) * scale;
                    *to = scaled;
                    *sum += scaled * scaled;
                }
            }
            for sum in &mut *sums {
                *sum = (*sum / norms.len() as f32 + OF_PIXEL).sqrt().recip();
            }
            for channel in 0..norms.len() {
                for (to, scale) in self.to.row(channel, y).iter_mut().zip(&*sums) {
                    *to *= scale;
                }
            }
        }
    }
}

refusal!(Unfit);

/// `nightflow::Normalised(features [1, C, H, W])`, of the same shape.
pub struct Normalise;

impl Operator for Normalise {
    type Kernel<'attr> = Normalised;

    fn name(&self) -> &str {
        NAME
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::required(TensorElementType::Float32) }]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [const { OperatorOutput::required(TensorElementType::Float32) }]
    }

    fn create_kernel<'attr>(&self, _: &KernelContext<'attr>) -> Result<Normalised> {
        Ok(Normalised::default())
    }
}

impl Kernel for Normalised {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (from, lengths) = input(context, NAME, 0)?;
        let shape = <[i64; 4]>::try_from(lengths).ok().filter(|shape| shape[0] == 1);
        let shape = shape
            .ok_or_else(|| Error::new(format!("{NAME}: features should be [1, C, H, W], they are {lengths:?}")))?;
        let to = output(context, 0, shape)?;
        let [_, channels, height, width] = shape.map(|length| usize::try_from(length).unwrap_or(0));
        self.run(from, [channels, height, width], to, &|count: usize, work: &(dyn Fn(usize) + Sync)| {
            spread(context, count, work)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use proptest::prelude::*;

    use super::*;
    use crate::flow::{
        convolutions::tests::{backwards, shared},
        cost_volume::tests::noise,
    };

    /// As the definition says, in 64 bits.
    fn defined(from: &[f32], [channels, height, width]: [usize; 3]) -> Vec<f64> {
        let cells = height * width;
        let mut values: Vec<f64> = from.iter().map(|value| f64::from(*value)).collect();
        for plane in values.chunks_exact_mut(cells) {
            let mean = plane.iter().sum::<f64>() / cells as f64;
            let variance = plane.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / cells as f64;
            plane.iter_mut().for_each(|value| *value = (*value - mean) / (variance + 1e-6).sqrt());
        }
        for p in 0..cells {
            let square = (0..channels).map(|c| values[c * cells + p].powi(2)).sum::<f64>() / channels as f64;
            (0..channels).for_each(|c| values[c * cells + p] /= (square + 0.05).sqrt());
        }
        values
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn features_are_normalised_as_defined(
            channels in 1usize..40, height in 1usize..20, width in 1usize..90, level in -3.0f32..3.0, seed in 0u64..1000,
        ) {
            let shape = [channels, height, width];
            let cells = height * width;
            // Every channel has a level and a deviation of its own.
            let from: Vec<f32> = noise(seed, channels * cells)
                .iter()
                .enumerate()
                .map(|(i, value)| level * (i / cells) as f32 + value * (1.0 + (i / cells % 5) as f32))
                .collect();
            let wanted = defined(&from, shape);
            let (mut found, mut again) = (vec![f32::NAN; from.len()], vec![f32::NAN; from.len()]);
            let mut operator = Normalised::default();
            let Ok(()) = operator.run::<Infallible>(&from, shape, &mut found, &backwards);
            let Ok(()) = operator.run::<Infallible>(&from, shape, &mut again, &shared);
            prop_assert_eq!(&found, &again);
            for (a, b) in found.iter().zip(&wanted) {
                prop_assert!((f64::from(*a) - b).abs() < 2e-4 * b.abs().max(1.0), "{} {}", a, b);
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let mut operator = Normalised::default();
        let none = |count: usize, work: &(dyn Fn(usize) + Sync)| {
            (0..count).for_each(work);
            Ok(())
        };
        let said = operator.run::<Unfit>(&[0.0; 11], [2, 2, 3], &mut [0.0; 12], &none).unwrap_err().to_string();
        assert_eq!(said, "features of 2 × 2 × 3 can't have [11, 12] values in and out");
        assert!(operator.run::<Unfit>(&[], [0, 2, 3], &mut [], &none).is_err());
    }
}
