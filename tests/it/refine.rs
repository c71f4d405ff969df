//! The gradients' last step: what it mends, what it leaves alone to the bit, and what must not confuse it.

use nightflow::{
    clock::Stamp,
    darkness::noise::Normals,
    exposure::{Exposed, Noise, Pair},
    flow::{Config, Error, Fake, Flow, Matcher, Model, Network, Own, Raster, Resolution, Slot, padding::Padded},
};

const SIZE: [usize; 2] = [128, 96];

/// A texture without repetition, about 0.4 ± 0.1, where the camera looks at (x, y).
fn texture(x: f64, y: f64, colour: usize) -> f64 {
    let mut draws = Normals::new(7, 0);
    let wave = |_| {
        let (angle, length) = (draws.uniform() * std::f64::consts::TAU, 4.0 + 20.0 * draws.uniform());
        let (sine, cosine) = angle.sin_cos();
        (std::f64::consts::TAU * ((x * cosine + y * sine) / length + draws.uniform()) + 0.1 * colour as f64).sin()
    };
    0.4 + 0.02 * (0..24).map(wave).sum::<f64>()
}

/// A frame whose point (x, y) shows the light of `seen`, with noise of this deviation in every pixel and colour.
fn frame(number: u64, noise: f64, seen: impl Fn(f64, f64, usize) -> f64) -> Exposed {
    let [width, height] = SIZE;
    let mut draws = Normals::new(number, 1);
    let mut rgb = Vec::with_capacity(3 * width * height);
    for colour in 0..3 {
        for pixel in 0..width * height {
            let (x, y) = ((pixel % width) as f64, (pixel / width) as f64);
            rgb.push((seen(x, y, colour) + noise * draws.draw()) as f32);
        }
    }
    Exposed {
        stamp: Stamp(number as i64 * 33_000_000),
        width,
        height,
        scale: [2.0; 2],
        rgb,
        saturated: vec![0; width * height],
        raw_mean: 0.4,
        gain: 1.0,
        generation: number,
        // Red, two greens and blue of a cell: the grey's variance is 6/16 of a plane's, and that of a pixel a quarter more.
        noise: (noise > 0.0).then_some(Noise { a: 0.0, b: 1.5 * noise * noise }),
        ..Exposed::default()
    }
}

/// Flow between two frames where the network says `vector` (pixels) everywhere and expects an error of `error`.
fn refined(older: &Exposed, newer: &Exposed, vector: [f32; 2], error: f32) -> (Vec<[f32; 2]>, Vec<f32>) {
    flow(Config { refine: true, ..Config::default() }, older, newer, vector, error)
}

fn flow(config: Config, older: &Exposed, newer: &Exposed, [u, v]: [f32; 2], error: f32) -> (Vec<[f32; 2]>, Vec<f32>) {
    let mut matcher = Matcher::with(&config, Box::new(Fake::shift(u, v).with_uncertainty(error)));
    let mut own = Own::default();
    let Flow { vectors, confidence, .. } = matcher.between(&Pair { older, newer, gain_step: None }, &mut own).unwrap();
    (vectors.as_chunks::<2>().0.iter().map(|[u, v]| [u / 2.0, v / 2.0]).collect(), confidence.to_vec())
}

/// Root mean square of the vectors' distance from `truth`, over the cells away from the edge that `of` takes.
fn off(vectors: &[[f32; 2]], truth: [f32; 2], of: impl Fn(usize, usize) -> bool) -> f64 {
    let [width, height] = SIZE.map(|side| side / 4);
    let inside = |cell: &usize| {
        let (column, row) = (cell % width, cell / width);
        (3..width - 3).contains(&column) && (3..height - 3).contains(&row) && of(column, row)
    };
    let cells: Vec<usize> = (0..vectors.len()).filter(inside).collect();
    let squares = cells.iter().map(|cell| {
        let [u, v] = vectors[*cell];
        f64::from(u - truth[0]).powi(2) + f64::from(v - truth[1]).powi(2)
    });
    (squares.sum::<f64>() / cells.len() as f64).sqrt()
}

#[test]
fn a_disturbed_vector_comes_much_nearer_to_the_truth() {
    // Noise in parts of 255, and what may be left of an error of 0.5 px.
    for (noise, left) in [(0.0, 0.02), (5.0, 0.08), (20.0, 0.25), (60.0, 0.4)] {
        for truth in [[0.3f32, -0.45], [2.5, 1.25], [-3.75, 0.5]] {
            let older = frame(1, noise / 255.0, texture);
            let [u, v] = truth.map(f64::from);
            let newer = frame(2, noise / 255.0, |x, y, colour| texture(x - u, y - v, colour));
            let (vectors, confidence) = refined(&older, &newer, [truth[0] + 0.4, truth[1] - 0.3], 0.6);
            let error = off(&vectors, truth, |_, _| true);
            println!("noise {noise}, shift {truth:?}: {error:.4} px of 0.5 are left");
            assert!(error < left, "noise {noise}, shift {truth:?}: {error:.4} px are left");
            let before = 1.0 - (-1.0f32 / 0.6).exp();
            assert!(confidence.iter().all(|confidence| *confidence == 0.0 || *confidence >= before));
        }
    }
}

#[test]
fn a_flat_image_leaves_every_vector_as_it_was() {
    let (older, newer) = (frame(1, 0.0, |_, _, _| 0.4), frame(2, 0.0, |_, _, _| 0.4));
    let plain = flow(Config { refine: false, ..Config::default() }, &older, &newer, [0.7, -0.3], 0.4);
    assert_eq!(refined(&older, &newer, [0.7, -0.3], 0.4), plain);
}

#[test]
fn noise_without_a_scene_moves_no_vector_far() {
    let (older, newer) = (frame(1, 0.1, |_, _, _| 0.4), frame(2, 0.1, |_, _, _| 0.4));
    let (vectors, _) = refined(&older, &newer, [0.7, -0.3], 0.4);
    let error = off(&vectors, [0.7, -0.3], |_, _| true);
    assert!(error < 0.1, "{error:.3} px beside an expected error of 0.4");
}

/// Columns of pixels that a pole of two cells hides, and how far it moves before what stands still.
const POLE: std::ops::Range<usize> = 56..64;
const MOVED: f32 = 1.5;

/// A network that draws the pole to what is behind it, and what is beside it to the pole: every vector is a mean of three columns.
struct Blurring(Model);

impl Network for Blurring {
    fn describe(&mut self, _: Slot, _: &Padded<'_>) -> Result<(), Error> {
        Ok(())
    }

    fn between(&mut self, _: Slot, scale: [f32; 2], out: Raster<'_>) -> Result<(), Error> {
        out.uncertainty.fill(0.8);
        let is_pole = |column: usize| POLE.contains(&(4 * column));
        for (cell, vector) in out.flow.chunks_exact_mut(2).enumerate() {
            let column = cell % (SIZE[0] / 4);
            let part = (column.saturating_sub(1)..=column + 1).filter(|column| is_pole(*column)).count() as f32 / 3.0;
            vector.copy_from_slice(&[MOVED * part * scale[0], 0.0]);
        }
        Ok(())
    }

    fn model(&self) -> &Model {
        &self.0
    }
}

#[test]
fn a_pole_is_told_from_what_is_behind_it() {
    let scene = |by: f64| {
        move |x: f64, y: f64, c: usize| {
            let hidden = x - by >= POLE.start as f64 && x - by < POLE.end as f64;
            if hidden { texture(x - by + 500.0, y, c) } else { texture(x, y, c) }
        }
    };
    for noise in [2.0, 10.0] {
        let older = frame(1, noise / 255.0, scene(0.0));
        let newer = frame(2, noise / 255.0, scene(f64::from(MOVED)));
        let step = [false, true].map(|refine_narrow| {
            let config = Config { refine: true, refine_narrow, ..Config::default() };
            let mut matcher = Matcher::with(&config, Box::new(Blurring(Model::default())));
            let mut own = Own::default();
            let flow = matcher.between(&Pair { older: &older, newer: &newer, gain_step: None }, &mut own).unwrap();
            let vectors: Vec<[f32; 2]> = flow.vectors.as_chunks().0.iter().map(|[u, v]| [u / 2.0, v / 2.0]).collect();
            // From the last column before the pole to the pole's first; the network says half a pixel, and both are off by that.
            let mean = |column: usize| {
                let rows = 3..SIZE[1] / 4 - 3;
                rows.clone().map(|row| vectors[row * SIZE[0] / 4 + column][0]).sum::<f32>() / rows.len() as f32
            };
            mean(POLE.start / 4) - mean(POLE.start / 4 - 1)
        });
        println!("noise {noise}: steps of {step:.2?} px, {MOVED} px is true");
        assert!(step[1] > MOVED - 0.2 && step[1] > step[0] + 0.3, "noise {noise}: {step:?}");
    }
}

#[test]
fn an_edge_between_two_motions_stays_where_it_is() {
    // The left half goes right over the right half, which goes left.
    let (before, after) = (SIZE[0] as f64 / 2.0, SIZE[0] as f64 / 2.0 + 1.0);
    let scene = |edge: f64, by: f64| {
        move |x: f64, y: f64, c: usize| if x < edge { texture(x - by, y, c) } else { texture(x + by + 300.0, y, c) }
    };
    let (older, newer) = (frame(1, 0.01, scene(before, 0.0)), frame(2, 0.01, scene(after, 1.0)));
    let middle = SIZE[0] / 8;
    for (truth, side) in [([1.0f32, 0.0], 0..middle), ([-1.0, 0.0], middle..2 * middle)] {
        let (vectors, _) = refined(&older, &newer, [0.0, 0.0], 1.2);
        let far = |column: usize, _| side.contains(&column) && column.abs_diff(middle) > 4;
        let error = off(&vectors, truth, far);
        assert!(error < 0.1, "{error:.3} px of 1 are left away from the edge");
    }
}

/// The step from a cell's vector to the truth that all gradients together ask for, pixels, and by how much noise may have moved it.
fn asked(noise: f64, truth: [f32; 2], said: [f32; 2]) -> ([f64; 2], f64) {
    let older = frame(1, noise / 255.0, texture);
    let [u, v] = truth.map(f64::from);
    let newer = frame(2, noise / 255.0, |x, y, colour| texture(x - u, y - v, colour));
    let config = Config { refine: true, ..Config::default() };
    let mut matcher = Matcher::with(&config, Box::new(Fake::shift(said[0], said[1]).with_uncertainty(0.6)));
    let mut own = Own::default();
    let pair = Pair { older: &older, newer: &newer, gain_step: None };
    let vectors = matcher.between(&pair, &mut own).unwrap().vectors.to_vec();
    let gradients = matcher.gradients().expect("it was refined");
    let [xx, xy, yy] = gradients.information;
    let [width, height] = SIZE.map(|side| side / 4);
    let (mut known, mut pull) = ([0.0f64; 3], [0.0f64; 2]);
    for cell in 0..width * height {
        if !(2..width - 2).contains(&(cell % width)) || !(2..height - 2).contains(&(cell / width)) {
            continue;
        }
        // Camera pixels are half as wide.
        let off = [0, 1].map(|axis| f64::from(2.0 * truth[axis] - vectors[2 * cell + axis]));
        let information = [xx, xy, yy].map(|plane| f64::from(plane[cell]));
        pull[0] += f64::from(gradients.pull[0][cell]) - information[0] * off[0] - information[1] * off[1];
        pull[1] += f64::from(gradients.pull[1][cell]) - information[1] * off[0] - information[2] * off[1];
        known = [0, 1, 2].map(|at| known[at] + information[at]);
    }
    let determinant = known[0] * known[2] - known[1] * known[1];
    let step = [
        (known[2] * pull[0] - known[1] * pull[1]) / determinant / 2.0,
        (known[0] * pull[1] - known[1] * pull[0]) / determinant / 2.0,
    ];
    (step, 0.5 * (known[0].min(known[2])).recip().sqrt())
}

#[test]
fn the_gradients_of_all_cells_together_ask_for_the_truth() {
    for (noise, bound) in [(0.0, 0.012), (20.0, 0.03), (60.0, 0.12)] {
        for truth in [[0.3f32, -0.45], [-3.75, 0.5]] {
            let ([right, down], sd) = asked(noise, truth, [truth[0] + 0.4, truth[1] - 0.3]);
            println!("noise {noise}, shift {truth:?}: {right:.4} and {down:.4} px off, {sd:.4} by noise");
            assert!(right.hypot(down) < bound, "noise {noise}, shift {truth:?}: {right:.4} and {down:.4} px off");
        }
    }
}

#[test]
fn gradients_say_nothing_of_a_flat_image_and_are_not_there_unless_it_is_refined() {
    let (older, newer) = (frame(1, 0.0, |_, _, _| 0.4), frame(2, 0.0, |_, _, _| 0.4));
    let pair = Pair { older: &older, newer: &newer, gain_step: None };
    let mut own = Own::default();
    let mut matcher = |refine, resolution| {
        let config = Config { refine, resolution, ..Config::default() };
        let mut matcher = Matcher::with(&config, Box::new(Fake::shift(0.7, -0.3)));
        assert!(matcher.gradients().is_none(), "there was no pair yet");
        matcher.between(&pair, &mut own).unwrap();
        matcher
    };
    let flat = matcher(true, Resolution::Quarter);
    let said = flat.gradients().expect("it was refined");
    let planes = said.information.iter().chain(&said.pull);
    assert!(planes.clone().all(|plane| plane.len() == SIZE[0] / 4 * SIZE[1] / 4));
    assert!(planes.flat_map(|plane| plane.iter()).all(|value| value.abs() < 1e-6));
    assert!(matcher(false, Resolution::Quarter).gradients().is_none());
    assert!(matcher(true, Resolution::Full).gradients().is_none(), "they stand on another raster");
}
