//! The operator `nightflow::Resized`: what a network brings from one level to the next one, finer or coarser, several maps at once.
//!
//! ONNX has an operator for each of these rules, but a node of its own for every map and every factor, each of which takes longer
//! to be called than to be computed where maps are small. Every result is computed by one thread in a fixed order, in that
//! of the plain graphs' operators, so that both have the same digits.

use std::{array, ops::RangeInclusive};

use ort::{
    Error, Result,
    operator::{ComputeContext, Kernel, KernelContext, Operator, OperatorInput, OperatorOutput},
    value::TensorElementType,
};

use super::{
    bands::{Band, Bands},
    convolutions::Spread,
    lanes::{Lanes, Unit, Work},
    operators::{input, output, refusal, spread_if},
};

const NAME: &str = "Resized";
/// The most maps that are resized at once.
const MAPS_MAX: usize = 4;
/// About how many bands a map is cut into, each of some of its channels.
const BANDS: usize = 8;
/// Fewer values than these are not worth waking other threads for.
const VALUES_SPREAD_MIN: usize = 1 << 14;

/// Where the cells that come out lie among those that go in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rule {
    /// Each is the mean of 2 × 2; an odd row or column at the end is left out.
    Halved,
    /// Each has a quarter of the area, between four of before (bilinear, those at the edge as if repeated).
    Doubled,
    /// Every second one is one of before; those between are means of their neighbours, those beyond the last are like it.
    Between,
}

impl Rule {
    const NAMED: [(&str, Self); 3] = [("halved", Self::Halved), ("doubled", Self::Doubled), ("between", Self::Between)];

    /// Rows and columns that come out of so many.
    pub fn size(self, size: [usize; 2]) -> [usize; 2] {
        match self {
            Self::Halved => size.map(|length| length / 2),
            Self::Doubled | Self::Between => size.map(|length| 2 * length),
        }
    }
}

/// A map: planes, one for each channel.
#[derive(Debug)]
pub struct Map<'a> {
    /// Channels × height × width.
    pub from: &'a [f32],
    /// As many channels of the other size.
    pub to: &'a mut [f32],
    /// What every value is multiplied with.
    pub gain: f32,
}

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("maps of {height} × {width} can't be {rule:?} with {found:?} values in and out")]
pub struct Unfit {
    rule: Rule,
    height: usize,
    width: usize,
    found: [usize; 2],
}

/// Resizes at most [`MAPS_MAX`] maps of so many rows and columns.
pub fn resize<E: From<Unfit>>(
    rule: Rule,
    size: [usize; 2],
    maps: &mut [Option<Map<'_>>; MAPS_MAX],
    spread: &impl Spread<E>,
) -> Result<(), E> {
    let [height, width] = size;
    let (cells, given) = (height * width, rule.size(size).iter().product::<usize>());
    for Map { from, to, .. } in maps.iter().flatten() {
        let channels = from.len().checked_div(cells).unwrap_or(0);
        if given == 0 || channels == 0 || [from.len(), to.len()] != [channels * cells, channels * given] {
            return Err(Unfit { rule, height, width, found: [from.len(), to.len()] }.into());
        }
    }
    let (unit, count) = (Unit::best(), maps.iter().flatten().count());
    let mut maps = maps.iter_mut();
    let cut: [_; MAPS_MAX] = array::from_fn(|_| {
        let Map { from, to, gain } = maps.next()?.as_mut()?;
        let channels = from.len() / cells;
        Some((&**from, *gain, Bands::new(to, [1, channels, given], channels.div_ceil(BANDS))))
    });
    spread(count * BANDS, &|number| {
        if let Some(Some((from, gain, to))) = cut.get(number / BANDS)
            && let Some(to) = to.take(number % BANDS)
        {
            unit.run(Resize { rule, size, from, gain: *gain, to });
        }
    })
}

/// Some channels of a map.
struct Resize<'a> {
    rule: Rule,
    size: [usize; 2],
    from: &'a [f32],
    gain: f32,
    to: Band<'a, f32>,
}

impl Work for Resize<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, _: L) {
        let Self { rule, size: [height, width], from, gain, .. } = self;
        for channel in self.to.first..self.to.end {
            let (from, to) = (&from[channel * height * width..][..height * width], self.to.row(0, channel));
            let row = |y: usize| &from[y.min(height - 1) * width..][..width];
            match rule {
                Rule::Halved => {
                    for (y, to) in to.chunks_exact_mut(width / 2).enumerate() {
                        halve([row(2 * y), row(2 * y + 1)], gain, to);
                    }
                }
                Rule::Doubled => {
                    for (y, to) in to.chunks_exact_mut(2 * width).enumerate() {
                        let first = y.div_ceil(2);
                        let parts = match y.is_multiple_of(2) {
                            _ if first == 0 || first == height => ONE,
                            true => FAR_AND_NEAR,
                            false => NEAR_AND_FAR,
                        };
                        double([row(first.saturating_sub(1)), row(first)], parts, gain, to);
                    }
                }
                Rule::Between => {
                    for (y, to) in to.chunks_exact_mut(2 * width).enumerate() {
                        fill([row(y / 2), row(y.div_ceil(2))], gain, to);
                    }
                }
            }
        }
    }
}

/// What two cells weigh a quarter of a cell from the first, from the second, and where both are the same one.
const NEAR_AND_FAR: [f32; 2] = [0.75, 0.25];
const FAR_AND_NEAR: [f32; 2] = [0.25, 0.75];
const ONE: [f32; 2] = [0.5; 2];

#[inline(always)]
fn halve([upper, lower]: [&[f32]; 2], gain: f32, to: &mut [f32]) {
    let fours = upper.as_chunks().0.iter().zip(lower.as_chunks().0);
    for (to, ([a, b], [c, d])) in to.iter_mut().zip(fours) {
        *to = gain * (0.25 * (a + b + c + d));
    }
}

/// A row that lies between two, which weigh so much.
#[inline(always)]
fn double([upper, lower]: [&[f32]; 2], [above, below]: [f32; 2], gain: f32, to: &mut [f32]) {
    let between = |[a, b]: [f32; 2], [c, d]: [f32; 2], [left, right]: [f32; 2]| {
        gain * (left * above * a + right * above * b + left * below * c + right * below * d)
    };
    let last = upper.len() - 1;
    (to[0], to[2 * last + 1]) =
        (between([upper[0]; 2], [lower[0]; 2], ONE), between([upper[last]; 2], [lower[last]; 2], ONE));
    let pairs = upper.iter().zip(&upper[1..]).zip(lower.iter().zip(&lower[1..]));
    for (to, ((a, b), (c, d))) in to[1..].as_chunks_mut::<2>().0.iter_mut().zip(pairs) {
        *to = [NEAR_AND_FAR, FAR_AND_NEAR].map(|parts| between([*a, *b], [*c, *d], parts));
    }
}

/// A row that is the mean of two, which may be the same.
#[inline(always)]
fn fill([upper, lower]: [&[f32]; 2], gain: f32, to: &mut [f32]) {
    let mean = |a: f32, b: f32| 0.5 * (a + b);
    let last = upper.len() - 1;
    let pairs = upper.iter().zip(&upper[1..]).zip(lower.iter().zip(&lower[1..]));
    for (to, ((a, b), (c, d))) in to.as_chunks_mut::<2>().0.iter_mut().zip(pairs) {
        let (here, following) = (mean(*a, *c), mean(*b, *d));
        *to = [gain * here, gain * mean(here, following)];
    }
    to[2 * last..].fill(gain * mean(upper[last], lower[last]));
}

refusal!(Unfit);

/// `nightflow::Resized(values [1, C, H, W] …)`, at most [`MAPS_MAX`] of them and as many outputs. Attributes: the `rule`, and a number
/// of `gains` for each, what it is multiplied with.
pub struct Resized;

/// A node of a graph.
pub struct Node {
    rule: Rule,
    gains: Vec<f32>,
}

impl Operator for Resized {
    type Kernel<'attr> = Node;

    fn name(&self) -> &str {
        NAME
    }

    fn versions(&self) -> RangeInclusive<u32> {
        1..=1
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        [const { OperatorInput::variadic(1).homogenous(TensorElementType::Float32) }]
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [const { OperatorOutput::variadic(1).homogenous(TensorElementType::Float32) }]
    }

    fn create_kernel<'attr>(&self, attributes: &KernelContext<'attr>) -> Result<Node> {
        let rule: String = attributes.get("rule").unwrap_or_default();
        let (known, found) = (Rule::NAMED.map(|(name, _)| name), Rule::NAMED.iter().find(|(name, _)| *name == rule));
        let Some((_, rule)) = found else {
            return Err(Error::new(format!("{NAME}: rule should be one of {known:?}, it is {rule:?}")));
        };
        let gains: Vec<f32> = attributes.get("gains").unwrap_or_default();
        let (inputs, outputs) = (attributes.inputs()?.len(), attributes.outputs()?.len());
        if inputs > MAPS_MAX || [outputs, gains.len()] != [inputs; 2] || gains.iter().any(|gain| !gain.is_finite()) {
            let found = format!("{inputs} inputs, {outputs} outputs, gains of {gains:?}");
            return Err(Error::new(format!(
                "{NAME}: as many of each are needed, at most {MAPS_MAX}, there are {found}"
            )));
        }
        Ok(Node { rule: *rule, gains })
    }
}

impl Kernel for Node {
    fn compute(&mut self, context: &ComputeContext) -> Result<()> {
        let (mut maps, mut size, mut values) = ([const { None }; MAPS_MAX], None, 0);
        for (index, (map, gain)) in maps.iter_mut().zip(&self.gains).enumerate() {
            let (from, lengths) = input(context, NAME, index)?;
            let [1, channels, height, width] = *lengths else {
                return Err(Error::new(format!("{NAME}: maps should be [1, C, H, W], one is {lengths:?}")));
            };
            let found = [height, width].map(|length| usize::try_from(length).unwrap_or(0));
            if *size.get_or_insert(found) != found {
                return Err(Error::new(format!("{NAME}: maps should be of one size, they are {size:?} and {found:?}")));
            }
            let [rows, columns] = self.rule.size(found).map(|length| length as i64);
            let to = output(context, index, [1, channels, rows, columns])?;
            values += to.len().max(from.len());
            *map = Some(Map { from, to, gain: *gain });
        }
        resize(self.rule, size.unwrap_or_default(), &mut maps, &|count: usize, work: &(dyn Fn(usize) + Sync)| {
            spread_if(values >= VALUES_SPREAD_MIN, context, count, work)
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

    /// What a cell of a row or column is made of by the rule, and what each of those weighs.
    fn defined(rule: Rule, at: usize, length: usize) -> [(usize, f64); 2] {
        let (near, last) = (at / 2, length - 1);
        match rule {
            Rule::Halved => [(2 * at, 0.5), (2 * at + 1, 0.5)],
            Rule::Doubled if at.is_multiple_of(2) => [(near, 0.75), (near.saturating_sub(1), 0.25)],
            Rule::Doubled => [(near, 0.75), ((near + 1).min(last), 0.25)],
            Rule::Between if at.is_multiple_of(2) => [(near, 1.0), (near, 0.0)],
            Rule::Between => [(near, 0.5), ((near + 1).min(last), 0.5)],
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]
        #[test]
        fn maps_are_resized_as_defined(
            rule in prop::sample::select(Rule::NAMED.map(|(_, rule)| rule).to_vec()),
            channels in prop::collection::vec(1usize..20, 1..=MAPS_MAX), height in 2usize..12, width in 2usize..70,
            gain in -2.0f32..2.0, seed in 0u64..1000,
        ) {
            let (size, [rows, columns]) = ([height, width], rule.size([height, width]));
            let from: Vec<_> = channels.iter().map(|channels| noise(seed, channels * height * width)).collect();
            let gains: Vec<f32> = (0..channels.len()).map(|map| gain + map as f32).collect();
            let resized = |threads: usize| {
                let mut to: Vec<_> = channels.iter().map(|channels| vec![f32::NAN; channels * rows * columns]).collect();
                let mut given = from.iter().zip(&mut to).zip(&gains);
                let mut maps = array::from_fn(|_| given.next().map(|((from, to), gain)| Map { from, to, gain: *gain }));
                let Ok(()) = match threads {
                    1 => resize::<Infallible>(rule, size, &mut maps, &backwards),
                    _ => resize::<Infallible>(rule, size, &mut maps, &shared),
                };
                to
            };
            let found = resized(1);
            prop_assert_eq!(&found, &resized(2));
            for ((from, found), gain) in from.iter().zip(&found).zip(&gains) {
                for (at, found) in found.iter().enumerate() {
                    let (channel, y, x) = (at / (rows * columns), at / columns % rows, at % columns);
                    let of = |(row, part): (usize, f64)| defined(rule, x, width).map(|(column, weight)| {
                        part * weight * f64::from(from[(channel * height + row) * width + column])
                    });
                    let sum: f64 = defined(rule, y, height).into_iter().flat_map(of).sum();
                    let wanted = f64::from(*gain) * sum;
                    prop_assert!((f64::from(*found) - wanted).abs() < 2e-6, "{:?} at {}: {} {}", rule, at, found, wanted);
                }
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let run = |rule: Rule, size: [usize; 2], from: usize, to: usize| {
            let (from, mut to) = (vec![0.0; from], vec![0.0; to]);
            let mut maps = [Some(Map { from: &from, to: &mut to, gain: 1.0 }), None, None, None];
            resize::<Unfit>(rule, size, &mut maps, &|count, work| {
                (0..count).for_each(work);
                Ok(())
            })
        };
        assert_eq!(run(Rule::Halved, [3, 4], 24, 4), Ok(()));
        assert_eq!(run(Rule::Between, [1, 1], 1, 4), Ok(()));
        for (rule, size, from, to) in [
            (Rule::Doubled, [2, 3], 7, 24),
            (Rule::Between, [2, 3], 6, 23),
            (Rule::Halved, [1, 4], 4, 0),
            (Rule::Doubled, [0, 4], 0, 0),
        ] {
            let said = run(rule, size, from, to).unwrap_err().to_string();
            assert!(said.contains(&format!("[{from}, {to}] values in and out")), "{said}");
        }
    }
}
