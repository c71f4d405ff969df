//! The recipes of the dark data set: the draws they rest on, their noise byte by byte, and the paper's table.

mod set;
mod table;

use nightflow::darkness::{
    gaussians::Gaussians,
    recipes::{Drawn, Recipe},
};
use xxhash_rust::xxh3::xxh3_64;

/// The part of N(0, 1) below t: Simpson's rule over the density, which shares nothing with what is tested.
fn below(t: f64) -> f64 {
    let t = t.clamp(-9.0, 9.0);
    let (steps, density) = (200, |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt());
    let width = t / f64::from(steps);
    let sum: f64 = (0..=steps)
        .map(|i| {
            let weight = if i == 0 || i == steps { 1.0 } else { f64::from(2 + 2 * (i % 2)) };
            weight * density(width * f64::from(i))
        })
        .sum();
    0.5 + sum * width / 3.0
}

fn draws(seed: u64, numbers: [u64; 2], count: usize) -> Vec<f64> {
    let mut draws = vec![0.0_f32; count];
    Gaussians::new(seed, numbers).fill(&mut draws);
    draws.into_iter().map(f64::from).collect()
}

#[test]
fn draws_are_normal_in_their_moments_and_tails() {
    let count = 4_000_000;
    let draws = draws(1, [2, 3], count);
    let n = count as f64;
    let moment = |power: i32| draws.iter().map(|x| x.powi(power)).sum::<f64>() / n;
    // Deviations of the moments of n draws: 1, √2, √15, √96 over √n.
    for (power, expected, deviation) in [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)] {
        let z = (moment(power) - expected) / (deviation / n).sqrt();
        assert!(z.abs() < 4.0, "moment {power} is {z} deviations off");
    }
    for edge in [1.0, 2.0, 3.0, 4.0, 4.5] {
        let expected = n * below(-edge);
        for side in [-1.0, 1.0] {
            let found = draws.iter().filter(|x| side * **x > edge).count() as f64;
            assert!((found - expected).abs() < 4.0 * expected.sqrt(), "beyond {edge}: {found} instead of {expected}");
        }
    }
}

#[test]
fn draws_follow_the_normal_curve() {
    let count = 200_000;
    let mut draws = draws(5, [0, 0], count);
    draws.sort_by(f64::total_cmp);
    let furthest =
        draws.iter().enumerate().map(|(i, x)| (below(*x) - (i as f64 + 0.5) / count as f64).abs()).fold(0.0, f64::max);
    // Kolmogorov and Smirnov: 1.95/√n is passed once in a thousand.
    assert!(furthest < 1.95 / (count as f64).sqrt(), "{furthest}");
}

#[test]
fn draws_do_not_know_of_each_other() {
    let count = 1 << 20;
    let of = |numbers| draws(11, numbers, count);
    let frame = of([4, 0]);
    // The same pair's other frame, the next pair, another seed.
    for (name, other) in
        [("frame", of([4, 1])), ("pair", of([5, 0])), ("seed", draws(12, [4, 0], count)), ("swapped", of([0, 4]))]
    {
        alike(name, &frame, &other);
    }
    // Pixels: next colour, next pixel, the other half of the transform, next block, next row of 512.
    for lag in [1, 3, 64, 128, 1536] {
        alike(&format!("lag {lag}"), &frame[lag..], &frame);
    }
}

/// Draws and their squares must be uncorrelated: 4.5 deviations.
fn alike(name: &str, left: &[f64], right: &[f64]) {
    let count = left.len().min(right.len());
    for power in [1, 2] {
        let (mean, spread) = [(0.0, 1.0), (1.0, 2.0)][power - 1];
        let product = |(x, y): (&f64, &f64)| (x.powi(power as i32) - mean) * (y.powi(power as i32) - mean);
        let sum: f64 = left.iter().zip(right).map(product).sum();
        let z = sum / (count as f64).sqrt() / spread;
        assert!(z.abs() < 4.5, "{name}: powers {power} are correlated, {z} deviations");
    }
}

/// A picture of equal pixels, as many as asked for.
fn even(pixels: usize, colour: [u8; 3]) -> Vec<u8> {
    colour.repeat(pixels)
}

/// What the recipe's text says of a pixel: its mean and the deviation of its noise, 0…1.
fn told(recipe: Recipe, drawn: &Drawn, colour: usize, byte: u8) -> [f64; 2] {
    let y = f64::from(byte) / 255.0;
    match recipe {
        Recipe::Paper => {
            let y = y.powf(drawn.gamma[colour]);
            [y, (drawn.a[colour] * y + drawn.b[colour]).sqrt()]
        }
        Recipe::Authors2021 => [y, drawn.a[colour] * y + drawn.b[colour]],
        // Grey passes the colour matrix unchanged, and what is far from white gets its gain.
        Recipe::Unprocess => {
            let linear = (0.5 - ((1.0 - 2.0 * y).asin() / 3.0).sin()).powf(2.2);
            let y = linear * drawn.gain[colour];
            [y, (drawn.a[colour] * y + drawn.b[colour]).sqrt()]
        }
    }
}

/// The probability of every byte that a pixel may become.
fn bytes_told(recipe: Recipe, drawn: &Drawn, colour: usize, byte: u8) -> Vec<f64> {
    let [mean, sigma] = told(recipe, drawn, colour, byte).map(|value| value * 255.0);
    let mut told = vec![0.0; 256];
    for value in 0..256 {
        // What is cut to `value` is between it and the next; what is rounded to it, half a step lower.
        let shift = if recipe == Recipe::Authors2021 { 0.0 } else { 0.5 };
        let low = if value == 0 { 0.0 } else { below((f64::from(value) - shift - mean) / sigma) };
        let high = if value == 255 { 1.0 } else { below((f64::from(value) + 1.0 - shift - mean) / sigma) };
        let last = if recipe == Recipe::Authors2021 {
            ((f64::from(value) * drawn.gain[colour]) as i32).min(255) as usize
        } else {
            value as usize
        };
        told[last] += high - low;
    }
    told
}

#[test]
fn every_byte_comes_as_often_as_the_recipe_says() {
    let pixels = 40_000;
    for recipe in Recipe::ALL {
        for pair in 0..6 {
            for byte in [20_u8, 90, 150, 200, 250] {
                if recipe == Recipe::Unprocess && byte == 250 {
                    continue;
                }
                let (mut older, mut newer) = (even(pixels, [byte; 3]), even(pixels, [byte; 3]));
                let drawn = recipe.darken(3, pair, &mut older, &mut newer).unwrap();
                assert_ne!(older, newer, "noise is fresh for each frame");
                for colour in 0..3 {
                    let told = bytes_told(recipe, &drawn, colour, byte);
                    assert_fits(&told, [&older, &newer], colour, &format!("{recipe} {pair} {byte}: {drawn:?}"));
                }
            }
        }
    }
}

/// Pearson's χ² over the bytes that come at least eight times.
fn assert_fits(told: &[f64], frames: [&[u8]; 2], colour: usize, what: &str) {
    let mut counts = vec![0_u32; 256];
    let mut total = 0.0;
    for byte in frames.iter().flat_map(|frame| frame.iter().skip(colour).step_by(3)) {
        counts[usize::from(*byte)] += 1;
        total += 1.0;
    }
    let (mut sum, mut freedom, mut rest_told, mut rest) = (0.0, -1.0, 0.0, 0.0);
    for (count, part) in counts.into_iter().zip(told) {
        let expected = part * total;
        if expected < 8.0 {
            rest_told += expected;
            rest += f64::from(count);
        } else {
            sum += (f64::from(count) - expected).powi(2) / expected;
            freedom += 1.0;
        }
    }
    if rest_told >= 8.0 {
        sum += (rest - rest_told).powi(2) / rest_told;
        freedom += 1.0;
    } else {
        assert!(rest < 40.0, "{what}, colour {colour}: {rest} bytes that should not come");
    }
    // χ² of k degrees is about N(k, 2k); the cube root of Wilson and Hilferty makes it so for few as well.
    if freedom > 0.0 {
        let k: f64 = freedom;
        let z = ((sum / k).cbrt() - (1.0 - 2.0 / (9.0 * k))) / (2.0 / (9.0 * k)).sqrt();
        assert!(z < 4.5, "{what}, colour {colour}: χ² of {sum} in {k} degrees");
    }
}

#[test]
fn what_is_drawn_is_what_the_recipes_say() {
    let of = |recipe: Recipe| -> Vec<Drawn> {
        let drawn = |pair| {
            let (mut older, mut newer) = (even(64, [120, 100, 80]), even(64, [120, 100, 80]));
            recipe.darken(9, pair, &mut older, &mut newer).unwrap()
        };
        (0..4000).map(drawn).collect()
    };
    let part = |all: &[Drawn], test: &dyn Fn(&Drawn) -> bool| {
        all.iter().filter(|drawn| test(drawn)).count() as f64 / all.len() as f64
    };
    let mean = |all: &[Drawn], value: &dyn Fn(&Drawn) -> f64| all.iter().map(value).sum::<f64>() / all.len() as f64;

    let authors = of(Recipe::Authors2021);
    // The mean of |N(0, s)| is s·√(2/π).
    let folded = std::f64::consts::FRAC_2_PI.sqrt();
    assert!((mean(&authors, &|drawn| drawn.a[0]) / (19.5 / 255.0 * folded) - 1.0).abs() < 0.04);
    assert!((mean(&authors, &|drawn| drawn.b[0] * 255.0) / (38.25 * folded) - 1.0).abs() < 0.04);
    let strong = part(&authors, &|drawn| drawn.b[0] * 255.0 > 30.0);
    println!("authors-2021: {:.1} % of pairs have a deviation above 30 in the dark", 100.0 * strong);
    assert!((strong - 0.433).abs() < 0.025, "{strong} of the pairs are above 30 where there is no light");
    let spread = mean(&authors, &|drawn| (1.0 / drawn.gain[1] - 1.0).powi(2)).sqrt();
    assert!((spread / 0.05 - 1.0).abs() < 0.05, "{spread}");

    let unprocess = of(Recipe::Unprocess);
    let centre = mean(&unprocess, &|drawn| drawn.a[0].ln());
    assert!((centre - 0.5 * (0.0001_f64.ln() + 0.012_f64.ln())).abs() < 0.1, "{centre}");
    let line = |drawn: &Drawn| drawn.b[0].ln() - 2.18 * drawn.a[0].ln() - 1.20;
    assert!(mean(&unprocess, &line).abs() < 0.02);
    assert!((mean(&unprocess, &|drawn| line(drawn).powi(2)).sqrt() / 0.26 - 1.0).abs() < 0.05);
    assert!(part(&unprocess, &|drawn| drawn.a[0] > 0.000_099 && drawn.a[0] < 0.012_01) == 1.0);

    let paper = of(Recipe::Paper);
    let gamma = mean(&paper, &|drawn| drawn.gamma.iter().sum::<f64>() / 3.0);
    assert!((gamma - 1.7).abs() < 0.02, "{gamma}");
    for drawn in &paper {
        let (profile, mean) = drawn.taken.unwrap();
        assert!((0.000_3..=0.401).contains(&mean), "{drawn:?}");
        let gain = 0.4 / mean;
        for colour in 0..3 {
            assert!((drawn.a[colour] - gain * profile.noise.a[colour]).abs() <= 1e-12 * drawn.a[colour]);
            assert!((drawn.b[colour] - gain * gain * profile.noise.b[colour]).abs() <= 1e-12 * drawn.b[colour]);
        }
    }
    let cameras: std::collections::BTreeSet<_> = paper.iter().map(|drawn| drawn.taken.unwrap().0.model).collect();
    assert!(cameras.len() > 5, "{cameras:?}");
}

#[test]
fn bright_light_survives_unprocessing() {
    let (mut older, mut newer) = (even(3000, [255; 3]), even(3000, [255; 3]));
    let drawn = Recipe::Unprocess.darken(1, 1, &mut older, &mut newer).unwrap();
    let mean = older.iter().map(|byte| f64::from(*byte)).sum::<f64>() / older.len() as f64;
    assert!(drawn.gain[0] < 0.6 && mean > 240.0, "white stays white whatever the gain: {mean}, {drawn:?}");
}

#[test]
fn bytes_are_those_of_every_other_machine() {
    // The last strip is a part of one: 100 × 70 pixels.
    let picture =
        |shift: usize| -> Vec<u8> { (0..21_000).map(|at| ((at * 7 + at / 300 * 3 + shift) % 256) as u8).collect() };
    for (recipe, expected) in [
        (Recipe::Paper, 0x2cdf_7f65_3fee_6129),
        (Recipe::Authors2021, 0xd61b_869e_5231_9205),
        (Recipe::Unprocess, 0x0998_c44f_e4b4_8db7),
    ] {
        let (mut older, mut newer) = (picture(0), picture(5));
        recipe.darken(2026, 17, &mut older, &mut newer).unwrap();
        older.append(&mut newer);
        assert_eq!(xxh3_64(&older), expected, "{recipe}: {:#x}", xxh3_64(&older));
    }
}
