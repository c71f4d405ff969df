//! The operator against its definition, written down as plainly as can be.

use std::cell::Cell;

use proptest::prelude::*;

use super::*;

struct Case {
    shape: Shape,
    older: Vec<f32>,
    newer: Vec<f32>,
    flow: Vec<f32>,
    sharpness: f32,
    gain: f32,
}

/// What calls every band.
type Spread<'a> = dyn Fn(usize, &(dyn Fn(usize) + Sync)) -> Result<(), Unfit> + 'a;

/// Numbers of −1 to 1 from a seed.
pub fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

impl Case {
    /// Features of unit deviation, and flow of up to `far` cells.
    fn new(shape: Shape, far: f32, seed: u64) -> Self {
        let cells = shape.cells();
        let features = |seed| noise(seed, shape.channels * cells).into_iter().map(|v| 1.7 * v).collect();
        let flow = noise(seed + 2, 2 * cells).into_iter().map(|v| far * v).collect();
        Self { shape, older: features(seed), newer: features(seed + 1), flow, sharpness: 2.0, gain: 4.0 }
    }

    fn computed(&self, work: &mut CostVolume, backwards: bool) -> (Vec<f32>, Vec<f32>) {
        let Case { shape, older, newer, flow, sharpness, gain } = self;
        let inputs = Inputs { older, newer, flow, sharpness: *sharpness, gain: *gain };
        // What was there before must not matter.
        let mut volume = vec![f32::NAN; shape.displacements() * shape.cells()];
        let mut argmax = vec![f32::NAN; 2 * shape.cells()];
        let outputs = Outputs { volume: &mut volume, argmax: &mut argmax };
        let order = |number: usize, count: usize| if backwards { count - 1 - number } else { number };
        let result: Result<(), Unfit> = work.compute(*shape, &inputs, outputs, |count, work| {
            (0..count).for_each(|number| work(order(number, count)));
            Ok(())
        });
        result.unwrap();
        (volume, argmax)
    }

    fn fetched(&self, c: usize, y: usize, x: usize) -> f64 {
        let Shape { height, width, .. } = self.shape;
        let at = y * width + x;
        let (u, v) = (f64::from(self.flow[at]), f64::from(self.flow[self.shape.cells() + at]));
        let (qx, qy) = (x as f64 + u, y as f64 + v);
        let mut sum = 0.0;
        for row in 0..height {
            for column in 0..width {
                let near = (1.0 - (qx - column as f64).abs()).max(0.0) * (1.0 - (qy - row as f64).abs()).max(0.0);
                sum += near * f64::from(self.newer[(c * height + row) * width + column]);
            }
        }
        sum
    }

    /// By the definition, in double precision.
    fn defined(&self) -> (Vec<f64>, Vec<f64>) {
        let Shape { channels, height, width, reach } = self.shape;
        let (cells, reach) = (self.shape.cells(), reach as isize);
        let mut fetched = Vec::new();
        for c in 0..channels {
            fetched.extend((0..cells).map(|at| self.fetched(c, at / width, at % width)));
        }
        let within = |y: isize, x: isize| y >= 0 && x >= 0 && y < height as isize && x < width as isize;
        let mut mean = Vec::new();
        for (dy, dx) in (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dy, dx))) {
            for (y, x) in (0..height as isize).flat_map(|y| (0..width as isize).map(move |x| (y, x))) {
                let (at, to) = (y * width as isize + x, (y + dy) * width as isize + x + dx);
                let product =
                    |c: usize| f64::from(self.older[c * cells + at as usize]) * fetched[c * cells + to as usize];
                let sum: f64 = if within(y + dy, x + dx) { (0..channels).map(product).sum() } else { 0.0 };
                mean.push(sum / channels as f64);
            }
        }
        let mut argmax = vec![0.0; 2 * cells];
        for at in 0..cells {
            let (y, x) = ((at / width) as isize, (at % width) as isize);
            let near: Vec<usize> = (y - 1..=y + 1)
                .flat_map(|y| (x - 1..=x + 1).map(move |x| (y, x)))
                .filter(|(y, x)| within(*y, *x))
                .map(|(y, x)| y as usize * width + x as usize)
                .collect();
            let planes = mean.chunks(cells);
            let pooled = planes.map(|plane| near.iter().map(|at| plane[*at]).sum::<f64>() / near.len() as f64);
            let logits: Vec<f64> = pooled.map(|mean| mean * f64::from(self.sharpness).exp()).collect();
            let most = logits.iter().copied().fold(f64::MIN, f64::max);
            let weights: Vec<f64> = logits.iter().map(|logit| (logit - most).exp()).collect();
            let total: f64 = weights.iter().sum();
            for (d, weight) in weights.iter().enumerate() {
                let (dy, dx) = (d as isize / (2 * reach + 1) - reach, d as isize % (2 * reach + 1) - reach);
                argmax[at] += weight / total * dx as f64;
                argmax[cells + at] += weight / total * dy as f64;
            }
        }
        (mean.into_iter().map(|mean| mean * f64::from(self.gain)).collect(), argmax)
    }

    fn holds(&self) {
        let (volume, argmax) = self.defined();
        for unit in Unit::all() {
            let found = self.computed(&mut CostVolume::with(unit), false);
            let worst = |found: &[f32], wanted: &[f64]| {
                let pairs = found.iter().zip(wanted);
                pairs.map(|(found, wanted)| (f64::from(*found) - wanted).abs()).fold(0.0, f64::max)
            };
            let (far, off) = (worst(&found.0, &volume), worst(&found.1, &argmax));
            assert!(far < 2e-5 && off < 2e-4, "{unit:?}, {:?}: volume {far:.1e}, argmax {off:.1e}", self.shape);
            // A maximum, or a fold of it, says nothing of what is not a number.
            assert!(found.0.iter().chain(&found.1).all(|value| value.is_finite()));
        }
    }
}

fn shape(channels: usize, height: usize, width: usize, reach: usize) -> Shape {
    Shape { channels, height, width, reach }
}

#[test]
fn the_networks_own_sizes_are_what_the_definition_says() {
    for (shape, far) in [(shape(128, 8, 10, 4), 0.0), (shape(128, 16, 20, 4), 3.0), (shape(32, 20, 40, 2), 5.0)] {
        Case::new(shape, far, 1).holds();
    }
}

/// With one channel there is no mean that would hide a last digit that a point lost.
#[test]
fn a_single_channel_is_fetched_with_all_its_digits() {
    for (width, far, seed) in [(24, 4.983_982_6, 138), (39, 12.0, 1), (320, 4.0, 2)] {
        Case::new(shape(1, 5, width, 0), far, seed).holds();
    }
}

#[test]
fn flow_beyond_reason_fetches_zero_and_reads_nothing_from_outside() {
    let size = shape(9, 6, 19, 4);
    for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -1e9, 1e9, 19.0, -20.0] {
        let mut case = Case::new(size, 2.0, 3);
        case.flow.iter_mut().step_by(3).for_each(|value| *value = odd);
        for unit in Unit::all() {
            let (volume, argmax) = case.computed(&mut CostVolume::with(unit), false);
            assert!(volume.iter().chain(&argmax).all(|value| value.is_finite()), "{unit:?}, {odd}");
        }
        let all = Case { flow: vec![odd; 2 * size.cells()], ..case };
        assert!(all.computed(&mut CostVolume::default(), false).0.iter().all(|value| *value == 0.0), "{odd}");
    }
}

#[test]
fn features_that_are_no_numbers_stay_visible() {
    let mut case = Case::new(shape(8, 5, 7, 2), 0.0, 4);
    case.older[17] = f32::NAN;
    for unit in Unit::all() {
        let (volume, argmax) = case.computed(&mut CostVolume::with(unit), false);
        assert!(volume.iter().any(|value| value.is_nan()) && argmax[17].is_nan(), "{unit:?}");
    }
}

#[test]
fn neither_the_order_of_the_bands_nor_former_calls_matter() {
    let case = Case::new(shape(24, 37, 29, 4), 4.0, 5);
    let mut work = CostVolume::default();
    let first = case.computed(&mut work, false);
    Case::new(shape(16, 50, 64, 2), 4.0, 6).computed(&mut work, true);
    let bits = |(volume, argmax): (Vec<f32>, Vec<f32>)| -> Vec<u32> {
        volume.iter().chain(&argmax).map(|value| value.to_bits()).collect()
    };
    let first = bits(first);
    assert!(first == bits(case.computed(&mut work, true)) && first == bits(case.computed(&mut work, false)));
}

#[test]
fn what_does_not_fit_is_refused_and_an_error_ends_the_work() {
    let case = Case::new(shape(4, 3, 5, 1), 0.0, 7);
    let calls = Cell::new(0);
    let mut outputs = (vec![0.0; 9 * 15], vec![0.0; 30]);
    let inputs = Inputs { older: &case.older, newer: &case.newer, flow: &case.flow, sharpness: 0.0, gain: 1.0 };
    let mut run = |shape, spread: &Spread<'_>| {
        let outputs = Outputs { volume: &mut outputs.0, argmax: &mut outputs.1 };
        CostVolume::default().compute(shape, &inputs, outputs, spread)
    };
    for wrong in
        [shape(4, 3, 4, 1), shape(4, 5, 3, 2), shape(0, 3, 5, 1), shape(4, 3, 5, 9), shape(4, usize::MAX, 5, 1)]
    {
        let refused = run(wrong, &|_, _| panic!("nothing is to be done"));
        assert!(refused.unwrap_err().to_string().contains("can't have 60, 60, 30 values in"), "{wrong:?}");
    }
    let failure = fits(shape(1, 1, 1, 1), &inputs, &Outputs { volume: &mut [], argmax: &mut [] }).unwrap_err();
    let failed = run(case.shape, &|_, _| {
        calls.set(calls.get() + 1);
        Err(failure)
    });
    assert_eq!((failed, calls.get()), (Err(failure), 1));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn any_size_is_what_the_definition_says(
        channels in 1usize..20, height in 1usize..9, width in 1usize..40, reach in 0usize..=5, far in 0.0f32..12.0, seed in 0u64..1000,
    ) {
        Case::new(shape(channels, height, width, reach), far, seed).holds();
    }
}
