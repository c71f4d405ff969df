//! Networks without weights and frames without a camera, for tests and benches where neither matters.

use crate::{
    clock::Stamp,
    exposure::Exposed,
    flow::{
        Error, Operators,
        network::{Model, Network, Raster, Slot},
        padding::Padded,
    },
};

/// Half of the side of the blocks that are compared.
const BLOCK: isize = 4;

/// A network that needs no files.
#[derive(Debug, Clone)]
pub struct Fake {
    answer: Answer,
    uncertainty: f32,
    frames: [Grey; 2],
    model: Model,
}

/// What it answers.
#[derive(Debug, Clone, Copy)]
enum Answer {
    Shift([f32; 2]),
    Match { reach: isize },
}

/// Frame `number` of a pattern that moves by two pixels to the left and one up a frame: `linear` is left empty, for
/// nothing but a network looks at it. `nightflow bench`'s rivals make the same.
pub fn pattern(width: usize, height: usize, number: u64) -> Exposed {
    let value = |i: usize| {
        let (x, y) = ((i % width) as f32 + 2.0 * number as f32, (i / width % height) as f32 + number as f32);
        0.4 + 0.2 * (0.31 * x + 0.17 * y).sin() * (0.23 * y - 0.11 * x).cos() + 0.1 * (0.9 * x).sin() * (0.7 * y).sin()
    };
    Exposed {
        stamp: Stamp::from_ns(number as i64 * 33_000_000),
        width,
        height,
        scale: [4.0, 4.0],
        rgb: (0..3 * width * height).map(value).collect(),
        saturated: vec![0; width * height],
        raw_mean: 0.1,
        gain: 4.0,
        generation: number + 1,
        ..Exposed::default()
    }
}

/// The mean of the three colours.
#[derive(Debug, Clone, Default)]
struct Grey {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Fake {
    /// Says that everything moved by (`u`, `v`) pixels of the developed image, whatever it is shown.
    pub fn shift(u: f32, v: f32) -> Self {
        Self::new("fake_shift", Answer::Shift([u, v]))
    }

    /// Compares blocks of 8 × 8 pixels at every whole shift of up to `reach` pixels and refines the best by a parabola:
    /// right to about a tenth of a pixel on clean, textured images that move by less than `reach`.
    pub fn matching(reach: usize) -> Self {
        Self::new("fake_match", Answer::Match { reach: reach as isize })
    }

    /// The same, with another expected error (network pixels) for every vector; it is 0.1 otherwise.
    pub fn with_uncertainty(mut self, pixels: f32) -> Self {
        self.uncertainty = pixels;
        self
    }

    fn new(name: &str, answer: Answer) -> Self {
        let (version, operators) = ("0".into(), Operators::Plain);
        let model = Model { name: name.into(), version, operators, provider: "none".into(), ..Model::default() };
        Self { answer, uncertainty: 0.1, frames: Default::default(), model }
    }
}

impl Network for Fake {
    fn describe(&mut self, slot: Slot, image: &Padded<'_>) -> Result<(), Error> {
        let Answer::Match { .. } = self.answer else { return Ok(()) };
        let cells = image.width * image.height;
        let mut rgb = vec![0.0; 3 * cells];
        image.write(&mut rgb);
        let grey = &mut self.frames[slot.index()];
        (grey.width, grey.height) = (image.width, image.height);
        grey.values.clear();
        grey.values.extend((0..cells).map(|i| (rgb[i] + rgb[cells + i] + rgb[2 * cells + i]) / 3.0));
        Ok(())
    }

    fn between(&mut self, older: Slot, scale: [f32; 2], out: Raster<'_>) -> Result<(), Error> {
        out.uncertainty.fill(self.uncertainty);
        match self.answer {
            Answer::Shift([u, v]) => {
                for vector in out.flow.chunks_exact_mut(2) {
                    vector.copy_from_slice(&[u * scale[0], v * scale[1]]);
                }
            }
            Answer::Match { reach } => {
                let (older, newer) = (&self.frames[older.index()], &self.frames[older.other().index()]);
                for (cell, vector) in out.flow.chunks_exact_mut(2).enumerate() {
                    let columns = older.width / 4;
                    let centre = ((cell % columns * 4 + 2) as isize, (cell / columns * 4 + 2) as isize);
                    let [u, v] = older.matched(newer, centre, reach);
                    vector.copy_from_slice(&[u * scale[0], v * scale[1]]);
                }
            }
        }
        Ok(())
    }

    fn model(&self) -> &Model {
        &self.model
    }
}

impl Grey {
    /// The shift of the block around `centre` that finds its like in `newer`.
    fn matched(&self, newer: &Grey, centre: (isize, isize), reach: isize) -> [f32; 2] {
        let mut best = (f32::INFINITY, 0, 0);
        for v in -reach..=reach {
            for u in -reach..=reach {
                let cost = self.difference(newer, centre, (u, v));
                // At equal cost the shorter shift: a flat block has not moved.
                let shorter = u * u + v * v < best.1 * best.1 + best.2 * best.2;
                if cost < best.0 || (cost == best.0 && shorter) {
                    best = (cost, u, v);
                }
            }
        }
        let (cost, u, v) = best;
        let refined = |before: f32, after: f32| {
            let bend = before - 2.0 * cost + after;
            if bend > 0.0 { ((before - after) / (2.0 * bend)).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let at = |u, v| self.difference(newer, centre, (u, v));
        [u as f32 + refined(at(u - 1, v), at(u + 1, v)), v as f32 + refined(at(u, v - 1), at(u, v + 1))]
    }

    /// Sum of squared differences; points outside are read at the edge.
    fn difference(&self, newer: &Grey, (x, y): (isize, isize), (u, v): (isize, isize)) -> f32 {
        let mut sum = 0.0;
        for j in y - BLOCK..y + BLOCK {
            for i in x - BLOCK..x + BLOCK {
                let step = self.at(i, j) - newer.at(i + u, j + v);
                sum += step * step;
            }
        }
        sum
    }

    fn at(&self, x: isize, y: isize) -> f32 {
        let (x, y) = (x.clamp(0, self.width as isize - 1), y.clamp(0, self.height as isize - 1));
        self.values[y as usize * self.width + x as usize]
    }
}
