//! The operator against convolutions as they are defined, in 64 bits.

use proptest::prelude::*;

use super::*;
use crate::flow::{
    convolutions::{
        chain::Unfit,
        tests::{backwards, shared},
    },
    cost_volume::tests::noise,
};

/// A convolution of 3 × 3 with zeros around, and its activation.
fn convolved(
    from: &[f64],
    [height, width]: [usize; 2],
    weights: &[f32],
    bias: &[f32],
    dilation: usize,
    slope: f32,
) -> Vec<f64> {
    let (cells, inputs) = (height * width, from.len() / (height * width));
    let at = |c: usize, y: isize, x: isize| {
        let inside = (0..height as isize).contains(&y) && (0..width as isize).contains(&x);
        if inside { from[c * cells + y as usize * width + x as usize] } else { 0.0 }
    };
    let mut values = vec![];
    for (o, bias) in bias.iter().enumerate() {
        for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
            let mut sum = f64::from(*bias);
            for (i, tap) in (0..inputs).flat_map(|i| (0..9).map(move |tap| (i, tap))) {
                let moved = |start: usize, tap: usize| start as isize + (tap as isize - 1) * dilation as isize;
                sum += f64::from(weights[(o * inputs + i) * 9 + tap]) * at(i, moved(y, tap / 3), moved(x, tap % 3));
            }
            values.push(if sum < 0.0 { f64::from(slope) * sum } else { sum });
        }
    }
    values
}

/// The greatest difference, as a part of the root of the mean square of the numbers.
fn apart(found: &[f32], wanted: &[f64]) -> f64 {
    assert_eq!(found.len(), wanted.len());
    let size = (wanted.iter().map(|v| v * v).sum::<f64>() / wanted.len() as f64).sqrt();
    found.iter().zip(wanted).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max) / size.max(1e-12)
}

fn chain_is_as_defined(size: [usize; 2], widths: &[usize], dilations: &[usize], dense: bool, seed: u64) {
    let (cells, last) = (size[0] * size[1], widths.len() - 2);
    let slope = |i: usize| if i == last { 1.0 } else { 0.1 };
    let read = |i: usize| if dense { &widths[..=i] } else { &widths[i..=i] };
    let inputs = |i: usize| read(i).iter().sum::<usize>();
    let weights: Vec<Vec<f32>> =
        (0..=last).map(|i| noise(seed + 10 + i as u64, inputs(i) * widths[i + 1] * 9)).collect();
    let bias: Vec<Vec<f32>> = (0..=last).map(|i| noise(seed + 50 + i as u64, widths[i + 1])).collect();
    let image = noise(seed, widths[0] * cells);
    let mut wanted = vec![image.iter().map(|v| f64::from(*v)).collect::<Vec<_>>()];
    for i in 0..=last {
        let from = if dense { wanted.concat() } else { wanted[i].clone() };
        wanted.push(convolved(&from, size, &weights[i], &bias[i], dilations[i], slope(i)));
    }
    let (one, rest) = image.split_at(cells * (widths[0] / 2));
    let parts = if one.is_empty() { vec![rest] } else { vec![one, rest] };
    for unit in Unit::all() {
        let layer =
            |i: usize| Layer::new(unit, &weights[i], (widths[i + 1], read(i)), &bias[i], dilations[i], slope(i));
        let mut chain = Chain::new(unit, (0..=last).map(layer).collect(), dense);
        let mut results = vec![];
        for threads in 0..2 {
            let mut given = vec![f32::NAN; widths[last + 1] * cells];
            let mut kept = vec![f32::NAN; if last > 0 { widths[last] * cells } else { 0 }];
            let before = (last > 0).then_some(&mut kept[..]);
            let Ok(()) = match threads {
                0 => chain.run(&parts, size, &mut given, before, &backwards),
                _ => chain.run(&parts, size, &mut given, before, &shared),
            };
            let error = apart(&given, &wanted[last + 1]);
            assert!(error < 1e-4, "{unit:?}, {size:?} {widths:?} {dilations:?} {dense}: {error}");
            assert!(last == 0 || apart(&kept, &wanted[last]) < 1e-4);
            results.push((given, kept));
        }
        assert_eq!(results[0], results[1], "one and two threads give the same");
    }
}

#[test]
fn a_chain_is_convolutions_one_after_the_other() {
    chain_is_as_defined([8, 10], &[181, 128, 64, 3], &[1, 1, 1], false, 1);
    chain_is_as_defined([32, 40], &[34, 64, 32, 2], &[2, 8, 1], false, 2);
    chain_is_as_defined([2, 2], &[3, 33], &[4], false, 3);
    chain_is_as_defined([1, 1], &[1, 1], &[1], false, 4);
}

#[test]
fn in_a_dense_chain_each_reads_all_before_it() {
    chain_is_as_defined([8, 10], &[181, 128, 64, 3], &[1, 1, 1], true, 5);
    chain_is_as_defined([32, 40], &[34, 64, 32, 2], &[2, 4, 1], true, 6);
}

#[test]
fn a_chain_serves_pictures_of_one_size_after_the_other() {
    let (unit, widths) = (Unit::best(), [5, 7, 2]);
    let chain = |weights: &[Vec<f32>]| {
        let layer =
            |i: usize| Layer::new(unit, &weights[i], (widths[i + 1], &widths[i..=i]), &noise(9, widths[i + 1]), 1, 0.1);
        Chain::new(unit, vec![layer(0), layer(1)], false)
    };
    let weights: Vec<Vec<f32>> = (0..2).map(|i| noise(i, widths[i as usize] * widths[i as usize + 1] * 9)).collect();
    let run = |chain: &mut Chain, size: [usize; 2]| {
        let mut given = vec![f32::NAN; 2 * size[0] * size[1]];
        let Ok(()) = chain.run(&[&noise(3, 5 * size[0] * size[1])], size, &mut given, None, &backwards);
        given
    };
    let mut one = chain(&weights);
    // Tiles are small in the first, large in the second.
    for size in [[6, 6], [40, 40], [6, 6], [24, 32]] {
        assert_eq!(run(&mut one, size), run(&mut chain(&weights), size), "{size:?}");
    }
}

#[test]
fn weights_that_differ_in_one_number_are_not_shared() {
    let unit = Unit::best();
    for (inputs, odd) in [1usize, 2, 30].into_iter().flat_map(|inputs| [0, 9 * inputs - 1].map(|odd| (inputs, odd))) {
        let given = |value: f32| {
            let mut weights = vec![0.5; 9 * inputs];
            weights[odd] = value;
            let mut layer = Layer::new(unit, &weights, (1, &[inputs]), &[0.0], 1, 1.0);
            layer.share(crate::flow::onnx_shared::first);
            let (mut chain, mut given) = (Chain::new(unit, vec![layer], false), vec![0.0; 9]);
            let Ok(()) = chain.run(&[&vec![1.0; 9 * inputs]], [3, 3], &mut given, None, &backwards);
            // Keeps the weights in use.
            (chain, given[4])
        };
        let (one, other) = (given(0.5), given(1.5));
        assert!((other.1 - one.1 - 1.0).abs() < 1e-5, "{inputs} inputs: {}, {}", one.1, other.1);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn a_chain_of_any_size_is_as_defined(
        height in 1usize..28, width in 1usize..40, inputs in 1usize..70, middle in 1usize..70, outputs in 1usize..70,
        dilations in prop::array::uniform2(1usize..5), dense: bool, seed in 0u64..1000,
    ) {
        chain_is_as_defined([height, width], &[inputs, middle, outputs], &dilations, dense, seed);
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let unit = Unit::best();
    let mut chain = Chain::new(unit, vec![Layer::new(unit, &[0.0; 18], (1, &[2]), &[0.0], 1, 1.0)], false);
    let mut run = |values: usize, given: usize| {
        chain.run::<Unfit>(&[&vec![0.0; values]], [2, 3], &mut vec![0.0; given], None, &|count, work| {
            (0..count).for_each(work);
            Ok(())
        })
    };
    assert!(run(12, 6).is_ok());
    for (values, given) in [(11, 6), (18, 6), (12, 5)] {
        let said = run(values, given).unwrap_err().to_string();
        assert!(said.contains("convolutions of 2 × 3, 2 channels to 1"), "{said}");
    }
}
