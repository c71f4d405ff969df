//! The operator `nightflow::Moved`: a level's flow after a look at it.
//!
//! With the flow f that a decoder looked from, its prediction (r, g), of which r is a residual and g a gate, and the soft
//! arg-max m of the cost volume, the level's flow is f + r + σ(g) · m. In ONNX's own operators that is six, each of which takes
//! longer to be called than to be computed where maps are small.

use std::ops::RangeInclusive;

use ort::{
    Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use super::{
    bands::{Band, Bands},
    convolutions::Spread,
    lanes::{self, Lanes, MOST, Unit, Work},
    operators::{input, output, refusal, spread_if},
};

const NAME: &str = "Moved";
/// About how many bands there are.
const BANDS: usize = 8;
/// Fewer cells than these are not worth waking other threads for.
const CELLS_SPREAD_MIN: usize = 1 << 12;

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "a flow of {flow} values can't have a prediction of {predicted} and an arg-max of {argmax}, and {moved} that come out"
)]
pub struct Unfit {
    flow: usize,
    predicted: usize,
    argmax: usize,
    moved: usize,
}

/// What goes in: planes of as many cells each.
#[derive(Debug, Clone, Copy)]
pub struct Inputs<'a> {
    /// Right and down.
    pub flow: &'a [f32],
    /// Residuals to the right and down, and gates before the sigmoid.
    pub predicted: &'a [f32],
    /// Right and down.
    pub argmax: &'a [f32],
}

/// The flow afterwards, right and down.
pub fn move_by<E: From<Unfit>>(
    unit: Unit,
    inputs: Inputs<'_>,
    moved: &mut [f32],
    spread: &impl Spread<E>,
) -> Result<(), E> {
    let Inputs { flow, predicted, argmax } = inputs;
    let cells = flow.len() / 2;
    if cells == 0 || [flow.len(), predicted.len(), argmax.len(), moved.len()] != [2, 3, 2, 2].map(|n| n * cells) {
        let [flow, predicted, argmax] = [flow, predicted, argmax].map(<[f32]>::len);
        return Err(Unfit { flow, predicted, argmax, moved: moved.len() }.into());
    }
    let each = cells.div_ceil(BANDS).next_multiple_of(MOST);
    let to = Bands::tiled(moved, [2, 1, cells], [1, each]);
    spread(cells.div_ceil(each), &|number| {
        if let Some(to) = to.take(number) {
            unit.run(Move { inputs, cells, to });
        }
    })
}

/// Some cells.
struct Move<'a> {
    inputs: Inputs<'a>,
    cells: usize,
    to: Band<'a, f32>,
}

impl Work for Move<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Self { inputs: Inputs { flow, predicted, argmax }, cells, .. } = self;
        let Band { left, right, .. } = self.to;
        for first in (left..right).step_by(L::COUNT) {
            let some = L::COUNT.min(right - first);
            let gate = sigmoid(lanes, loaded(lanes, &predicted[2 * cells + first..], some));
            for plane in 0..2 {
                let of = |values: &[f32]| loaded(lanes, &values[plane * cells + first..], some);
                let near = lanes.add(of(flow), of(predicted));
                let found = lanes.add(near, lanes.mul(gate, of(argmax)));
                let to = &mut self.to.row(plane, 0)[first - left..];
                if some == L::COUNT {
                    lanes.store(found, to);
                } else {
                    let mut last = [0.0; MOST];
                    lanes.store(found, &mut last);
                    to[..some].copy_from_slice(&last[..some]);
                }
            }
        }
    }
}

/// The next numbers, or so many as there are.
#[inline(always)]
fn loaded<L: Lanes>(lanes: L, from: &[f32], some: usize) -> L::V {
    if some == L::COUNT {
        return lanes.load(from);
    }
    let mut last = [0.0; MOST];
    last[..some].copy_from_slice(&from[..some]);
    lanes.load(&last)
}

/// 1 / (1 + e⁻ˣ), with exponentials of what is not positive alone; not-a-number stays so.
#[inline(always)]
fn sigmoid<L: Lanes>(lanes: L, x: L::V) -> L::V {
    let zero = lanes.splat(0.0);
    let least = |x: L::V| lanes.sub(zero, lanes.max(zero, x));
    let (of_negative, of_positive) = (lanes::exp(lanes, least(lanes.sub(zero, x))), lanes::exp(lanes, least(x)));
    lanes.div(of_negative, lanes.add(of_negative, of_positive))
}

refusal!(Unfit);

/// `nightflow::Moved(flow [1, 2, H, W], predicted [1, 3, H, W], argmax [1, 2, H, W])`, which gives flow [1, 2, H, W].
pub struct Moved;

/// A node of a graph.
pub struct Node;

impl Operator for Moved {
    type Kernel<'attr> = Node;

    fn name(&self) -> &str {
        NAME
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::required(TensorElementType::Float32) }; 3]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [const { OperatorOutput::required(TensorElementType::Float32) }]
    }

    fn create_kernel<'attr>(&self, _: &KernelContext<'attr>) -> Result<Node> {
        Ok(Node)
    }
}

impl Kernel for Node {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (flow, lengths) = input(context, NAME, 0)?;
        let [1, 2, height, width] = *lengths else {
            return Err(Error::new(format!("{NAME}: flow should be [1, 2, H, W], it is {lengths:?}")));
        };
        let (predicted, of_predicted) = input(context, NAME, 1)?;
        let (argmax, of_argmax) = input(context, NAME, 2)?;
        if of_predicted != [1, 3, height, width] || of_argmax != lengths {
            let found = format!("{of_predicted:?} and {of_argmax:?}");
            return Err(Error::new(format!("{NAME}: prediction and arg-max don't fit a flow of {lengths:?}: {found}")));
        }
        let moved = output(context, 0, [1, 2, height, width])?;
        let inputs = Inputs { flow, predicted, argmax };
        move_by(Unit::best(), inputs, moved, &|count: usize, work: &(dyn Fn(usize) + Sync)| {
            spread_if(argmax.len() >= 2 * CELLS_SPREAD_MIN, context, count, work)
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

    fn moved(unit: Unit, flow: &[f32], predicted: &[f32], argmax: &[f32]) -> Vec<f32> {
        let inputs = Inputs { flow, predicted, argmax };
        let (mut found, mut again) = (vec![f32::NAN; flow.len()], vec![f32::NAN; flow.len()]);
        let Ok(()) = move_by::<Infallible>(unit, inputs, &mut found, &backwards);
        let Ok(()) = move_by::<Infallible>(unit, inputs, &mut again, &shared);
        let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&found), bits(&again));
        found
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn flow_is_moved_as_defined(cells in 1usize..400, far in 0.1f32..40.0, seed in 0u64..1000) {
            let of = |planes: usize, seed: u64| -> Vec<f32> {
                noise(seed, planes * cells).iter().map(|value| far * value).collect()
            };
            let (flow, predicted, argmax) = (of(2, seed), of(3, seed + 1), of(2, seed + 2));
            for unit in Unit::all() {
                for (at, found) in moved(unit, &flow, &predicted, &argmax).iter().enumerate() {
                    let [flow, residual, argmax, gate] =
                        [flow[at], predicted[at], argmax[at], predicted[2 * cells + at % cells]].map(f64::from);
                    let wanted = flow + residual + argmax / (1.0 + (-gate).exp());
                    // Exponentials are off by so much where a processor rounds twice.
                    let allowed = 1e-6 * f64::from(far) * (1.0 + 0.1 * gate.abs());
                    prop_assert!((f64::from(*found) - wanted).abs() < allowed, "{:?} {} {}", unit, found, wanted);
                }
            }
        }
    }

    #[test]
    fn gates_shut_and_open_and_what_is_no_number_stays_so() {
        let gates = [-1e30, -200.0, 0.0, 200.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
        let predicted = [[0.0; 14].as_slice(), gates.as_slice()].concat();
        for unit in Unit::all() {
            let found = moved(unit, &[1.0; 14], &predicted, &[4.0; 14]);
            for (found, wanted) in found.chunks(7).flat_map(|plane| plane.iter().zip([1.0, 1.0, 3.0, 5.0, 5.0, 1.0])) {
                assert!((found - wanted).abs() < 1e-6, "{unit:?}: {found} {wanted}");
            }
            assert!(found[6].is_nan() && found[13].is_nan(), "{unit:?}");
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let run = |[flow, predicted, argmax, moved]: [usize; 4]| {
            let inputs =
                Inputs { flow: &vec![0.0; flow], predicted: &vec![0.0; predicted], argmax: &vec![0.0; argmax] };
            move_by::<Unfit>(Unit::best(), inputs, &mut vec![0.0; moved], &|count, work| {
                (0..count).for_each(work);
                Ok(())
            })
        };
        assert_eq!(run([4, 6, 4, 4]), Ok(()));
        for wrong in [[0, 0, 0, 0], [4, 5, 4, 4], [4, 6, 2, 4], [4, 6, 4, 6], [5, 6, 4, 4]] {
            let said = run(wrong).unwrap_err().to_string();
            assert!(said.contains(&format!("prediction of {}", wrong[1])), "{said}");
        }
    }
}
