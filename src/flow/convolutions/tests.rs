//! The operators against convolutions as they are defined, in 64 bits, of numbers that are rounded where theirs are.

use std::convert::Infallible;

use proptest::prelude::*;
use rayon::prelude::*;

use super::{
    encoder::Numbers,
    tiles::{narrowed, widened},
    *,
};
use crate::flow::{cost_volume::tests::noise, winograd};

/// How numbers are rounded.
type Round = fn(f64) -> f64;

/// As bf16 has them.
fn to_bf16(value: f64) -> f64 {
    f64::from(widened(narrowed(value as f32)))
}

/// Planes of f64.
#[derive(Clone)]
struct Planes {
    values: Vec<f64>,
    shape: [usize; 3],
}

impl Planes {
    fn at(&self, c: usize, y: isize, x: isize) -> f64 {
        let [_, height, width] = self.shape;
        let inside = (0..height as isize).contains(&y) && (0..width as isize).contains(&x);
        if inside { self.values[(c * height + y as usize) * width + x as usize] } else { 0.0 }
    }

    fn rounded(mut self, round: Round) -> Self {
        self.values.iter_mut().for_each(|value| *value = round(*value));
        self
    }

    /// By weights that are rounded.
    fn convolved(
        &self,
        weights: &[f32],
        [outputs, inputs, rows, columns]: [usize; 4],
        bias: &[f32],
        (step, round): (Step, Round),
    ) -> Self {
        let [channels, height, width] = self.shape;
        assert_eq!(channels, inputs);
        let [down, right] = step.stride;
        let shape = [outputs, height.div_ceil(down), width.div_ceil(right)];
        let mut values = vec![];
        for o in 0..outputs {
            for (y, x) in (0..shape[1]).flat_map(|y| (0..shape[2]).map(move |x| (y, x))) {
                let mut sum = f64::from(bias.get(o).copied().unwrap_or(0.0));
                for (i, tap) in (0..inputs).flat_map(|i| (0..rows * columns).map(move |tap| (i, tap))) {
                    let at = |start: usize, tap: usize, length: usize| {
                        start as isize + (tap as isize - (length / 2) as isize) * step.dilation as isize
                    };
                    let (from_y, from_x) = (at(y * down, tap / columns, rows), at(x * right, tap % columns, columns));
                    let weight = round(f64::from(weights[(o * inputs + i) * rows * columns + tap]));
                    sum += weight * self.at(i, from_y, from_x);
                }
                values.push(if sum < 0.0 { f64::from(step.slope) * sum } else { sum });
            }
        }
        Self { values, shape }
    }

    /// By the mean and the deviation before they are rounded.
    fn normalised(mut self, round: Round) -> Self {
        let cells = self.shape[1] * self.shape[2];
        for plane in self.values.chunks_exact_mut(cells) {
            let mean = plane.iter().sum::<f64>() / cells as f64;
            let variance = plane.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / cells as f64;
            plane.iter_mut().for_each(|v| *v = (round(*v) - mean) / (variance + 1e-5).sqrt());
        }
        self
    }

    fn positive(mut self) -> Self {
        self.values.iter_mut().for_each(|value| *value = value.max(0.0));
        self
    }
}

/// Every band on one thread, and backwards, which must not matter.
pub fn backwards(count: usize, work: &(dyn Fn(usize) + Sync)) -> Result<(), Infallible> {
    (0..count).rev().for_each(work);
    Ok(())
}

/// On as many threads as there are.
pub fn shared(count: usize, work: &(dyn Fn(usize) + Sync)) -> Result<(), Infallible> {
    (0..count).into_par_iter().for_each(work);
    Ok(())
}

/// Root of the mean square of the differences, as a part of that of the numbers.
fn apart(found: &[f32], wanted: &[f64]) -> f64 {
    assert_eq!(found.len(), wanted.len());
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let differences = square(&mut found.iter().zip(wanted).map(|(a, b)| f64::from(*a) - b));
    (differences / square(&mut wanted.iter().copied()).max(1e-12)).sqrt()
}

fn chain_is_as_defined(sizes: [usize; 2], widths: &[usize], dilations: &[usize], dense: bool, seed: u64) {
    let [height, width] = sizes;
    let cells = height * width;
    let last = widths.len() - 2;
    let steps: Vec<Step> = dilations
        .iter()
        .enumerate()
        .map(|(i, dilation)| Step { stride: [1; 2], dilation: *dilation, slope: if i == last { 1.0 } else { 0.1 } })
        .collect();
    let sizes: Vec<usize> = (0..=last).map(|i| if (seed as usize + i).is_multiple_of(3) { 1 } else { 3 }).collect();
    let read = |i: usize| if dense { &widths[..=i] } else { &widths[i..=i] };
    let shape = |i: usize| [widths[i + 1], read(i).iter().sum(), sizes[i], sizes[i]];
    let weights: Vec<Vec<f32>> = (0..=last).map(|i| noise(seed + 10 + i as u64, shape(i).iter().product())).collect();
    let bias: Vec<Vec<f32>> = (0..=last).map(|i| noise(seed + 50 + i as u64, widths[i + 1])).collect();
    let image = noise(seed, widths[0] * cells);
    let mut wanted =
        vec![Planes { values: image.iter().map(|v| f64::from(*v)).collect(), shape: [widths[0], height, width] }];
    for i in 0..=last {
        let mut from = wanted[i].clone();
        if dense {
            from.values = wanted.iter().flat_map(|planes| &planes.values).copied().collect();
            from.shape[0] = shape(i)[1];
        }
        let from = from.rounded(to_bf16);
        wanted.push(from.convolved(&weights[i], shape(i), &bias[i], (steps[i], to_bf16)));
    }
    let parts: Vec<&[f32]> = if widths[0] > 2 {
        let (one, rest) = image.split_at(2 * cells);
        vec![one, rest]
    } else {
        vec![&image]
    };
    let mut results: Vec<(Vec<f32>, Vec<f32>)> = vec![];
    for unit in Unit::all() {
        let layer = |i: usize| Layer::of_maps(&weights[i], shape(i), read(i), &bias[i], steps[i]);
        let mut chain = Chain::new(unit, (0..=last).map(layer).collect(), dense);
        let mut both = (
            vec![f32::NAN; widths[last + 1] * cells],
            if last > 0 { vec![f32::NAN; widths[last] * cells] } else { vec![] },
        );
        for threads in 0..2 {
            let before = (last > 0).then_some(&mut both.1[..]);
            let done = match threads {
                0 => chain.run(&parts, [height, width], &mut both.0, before, &backwards),
                _ => chain.run(&parts, [height, width], &mut both.0, before, &shared),
            };
            let Ok(()) = done;
            let error = apart(&both.0, &wanted[last + 1].values);
            assert!(error < 4e-3, "{unit:?}, {sizes:?} {widths:?} {dilations:?}: {error}");
            if last > 0 {
                assert!(apart(&both.1, &wanted[last].values) < 4e-3);
            }
            results.push(both.clone());
        }
    }
    for two in results.chunks_exact(2) {
        assert_eq!(two[0], two[1], "one and two threads give the same");
    }
}

#[test]
fn a_chain_is_convolutions_one_after_the_other() {
    chain_is_as_defined([8, 10], &[181, 128, 64, 3], &[1, 1, 1], false, 1);
    chain_is_as_defined([32, 40], &[34, 64, 32, 2], &[2, 8, 1], false, 2);
    chain_is_as_defined([2, 2], &[3, 33], &[4], false, 3);
}

#[test]
fn in_a_dense_chain_each_reads_all_before_it() {
    chain_is_as_defined([8, 10], &[181, 128, 64, 3], &[1, 1, 1], true, 1);
    chain_is_as_defined([32, 40], &[34, 64, 32, 2], &[2, 4, 1], true, 2);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn a_chain_of_any_size_is_as_defined(
        height in 1usize..20, width in 1usize..40, inputs in 1usize..70, middle in 1usize..70, outputs in 1usize..70,
        dilations in prop::array::uniform2(1usize..5), dense: bool, seed in 0u64..1000,
    ) {
        chain_is_as_defined([height, width], &[inputs, middle, outputs], &dilations, dense, seed);
    }
}

/// Weights of an encoder with narrow layers.
fn shapes(first: usize, layers: [usize; 3], last: usize) -> Vec<[usize; 4]> {
    let (mut shapes, mut width) = (vec![[first, 3, 7, 7]], first);
    for (layer, out) in layers.into_iter().enumerate() {
        for unit in 0..2 {
            let inner = out / 4;
            shapes.extend([[inner, width, 1, 1], [inner, inner, 3, 3], [out, inner, 1, 1]]);
            if layer > 0 && unit == 0 {
                shapes.push([out, width, 1, 1]);
            }
            width = out;
        }
    }
    shapes.extend([[last, width, 1, 1], [20, layers[1], 1, 1], [9, last, 1, 1]]);
    shapes
}

/// What negative results are multiplied with, and where no norm follows: the last three.
fn slope(number: usize) -> f32 {
    if number + 1 == CONVOLUTIONS { 0.1 } else { 1.0 }
}

/// Where results go to.
fn slices(planes: &mut [Vec<f32>; 3]) -> [&mut [f32]; 3] {
    planes.each_mut().map(Vec::as_mut_slice)
}

#[test]
fn the_encoder_is_raft_smalls() {
    encoder_is_raft_smalls::<Narrow>(&Unit::all(), to_bf16, [0.01, 0.02, 0.02]);
    encoder_is_raft_smalls::<Wide>(&winograd::Unit::all(), |value| value, [1e-5; 3]);
}

/// Within these parts of what it should be.
fn encoder_is_raft_smalls<N: Numbers>(units: &[N::Unit], round: Round, allowed: [f64; 3]) {
    let shapes = shapes(32, [32, 64, 96], 40);
    assert_eq!(shapes.len(), CONVOLUTIONS);
    let values: Vec<Vec<f32>> =
        shapes.iter().enumerate().map(|(i, shape)| noise(i as u64, shape.iter().product())).collect();
    let bias: Vec<Vec<f32>> = shapes.iter().enumerate().map(|(i, shape)| noise(100 + i as u64, shape[0])).collect();
    let weights: Vec<Weights<'_>> = (0..shapes.len())
        .map(|i| Weights { values: &values[i], shape: shapes[i], bias: &bias[i], slope: slope(i) })
        .collect();
    let (height, width) = (48, 56);
    // Waves, so that norms have something to do.
    let image: Vec<f32> = (0..3 * height * width)
        .map(|i| ((i % width) as f32 * 0.3 + (i / width) as f32 * 0.11).sin() * 0.6 + 0.1 * noise(i as u64, 1)[0])
        .collect();
    let mut number = 0;
    let mut convolve = |from: &Planes, stride: usize, biased: bool| {
        let step = Step { stride: [stride; 2], dilation: 1, slope: slope(number) };
        let bias = if biased { &bias[number][..] } else { &[] };
        number += 1;
        from.convolved(&values[number - 1], shapes[number - 1], bias, (step, round))
    };
    let view = View { factor: 1.5, offset: -0.25, shift: 2 };
    let seen = |i: usize| {
        let (c, y, x) = (i / (height * width), i / width % height + view.shift, i % width + view.shift);
        let inside = y < height && x < width;
        if inside { f64::from(view.factor * image[(c * height + y) * width + x] + view.offset) } else { 0.0 }
    };
    let image_planes =
        Planes { values: (0..image.len()).map(seen).collect(), shape: [3, height, width] }.rounded(round);
    let smooth = |planes: Planes| planes.normalised(round).positive().rounded(round);
    let mut x = smooth(convolve(&image_planes, 2, false));
    let mut quarter = None;
    for (layer, stride) in [1, 2, 2].into_iter().enumerate() {
        for stride in [stride, 1] {
            let y = smooth(convolve(&x, 1, false));
            let y = smooth(convolve(&y, stride, false));
            let y = convolve(&y, 1, false).normalised(round).positive();
            let short = if stride > 1 { convolve(&x, stride, false).normalised(round) } else { x.clone() };
            let mut sum = y;
            sum.values.iter_mut().zip(&short.values).for_each(|(a, b)| *a += b);
            x = sum.positive().rounded(round);
        }
        if layer == 1 {
            quarter = Some(x.clone());
        }
    }
    let eighth = convolve(&x, 1, true);
    let quarter = convolve(&quarter.unwrap(), 1, true);
    let projected = convolve(&eighth.clone().rounded(round), 1, true);
    for &unit in units {
        let mut encoder = Encoder::<N>::new(unit, view, &weights).unwrap();
        assert_eq!(encoder.outputs(), [20, 40, 9]);
        let mut found =
            [(20, 4), (40, 8), (9, 8)].map(|(channels, part)| vec![f32::NAN; channels * height * width / part / part]);
        let mut again = found.clone();
        let Ok(()) = encoder.run::<Infallible>(&image, [height, width], slices(&mut found), &backwards);
        let Ok(()) = encoder.run::<Infallible>(&image, [height, width], slices(&mut again), &shared);
        assert_eq!(found, again);
        // Nor does it matter what was looked at before.
        let wider = noise(5, 3 * 64 * 96);
        let mut of_wider = [vec![0.0; 20 * 16 * 24], vec![0.0; 40 * 8 * 12], vec![0.0; 9 * 8 * 12]];
        let Ok(()) = encoder.run::<Infallible>(&wider, [64, 96], slices(&mut of_wider), &shared);
        let Ok(()) = encoder.run::<Infallible>(&image, [height, width], slices(&mut again), &backwards);
        assert_eq!(found, again);
        for ((found, wanted), allowed) in found.iter().zip([&quarter, &eighth, &projected]).zip(allowed) {
            let error = apart(found, &wanted.values);
            assert!(error < allowed, "{unit:?}: {error}");
        }
    }
}

#[test]
fn weights_of_another_network_are_refused() {
    let mut shapes = shapes(32, [32, 64, 96], 40);
    shapes[3] = [32, 9, 1, 1];
    let values: Vec<Vec<f32>> = shapes.iter().map(|shape| vec![0.1; shape.iter().product()]).collect();
    let bias = [0.0; 96];
    let weights: Vec<Weights<'_>> = (0..shapes.len())
        .map(|i| Weights { values: &values[i], shape: shapes[i], bias: &bias[..shapes[i][0]], slope: 1.0 })
        .collect();
    let error = Encoder::<Narrow>::new(Unit::Plain, View::WHOLE, &weights).unwrap_err().to_string();
    assert_eq!(
        error,
        "the encoder's convolution 3 should have 1 × 1 weights of Some(8) inputs and a bias for each output, it has [32, 9, 1, 1]"
    );
    let error = Encoder::<Narrow>::new(Unit::Plain, View::WHOLE, &weights[..2]).unwrap_err().to_string();
    assert!(error.contains("the encoder's convolution"), "{error}");
}
