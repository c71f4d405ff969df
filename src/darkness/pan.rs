//! Real sensor noise with an exact truth: one raw photograph becomes a pan whose consecutive frames share no pixel.
//!
//! The photograph's Bayer cells fall into four sub-lattices by the parity of their column and row. Each frame is a window
//! of one sub-lattice, read as a mosaic of its own, and the next frame comes from another one: their noise is independent
//! because no pixel is in both. Sub-lattices lie half a cell (one pixel of the mosaic) apart, so that the displacement
//! is known exactly. Frames that are two or more apart may come from the same sub-lattice and then share pixels.

use std::f64::consts::TAU;

use super::noise::{Noise, Normals};

/// A raw photograph with red at its first pixel.
#[derive(Debug, Clone)]
pub struct Photograph {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Raw counts, RGGB.
    pub counts: Vec<u16>,
    /// Counts without light.
    pub black: f64,
    /// Counts of a full pixel.
    pub white: f64,
}

/// How it is panned over.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Draws the noise of the darkened half.
    pub seed: u64,
    /// Columns and rows of a frame; even.
    pub size: [usize; 2],
    /// How many frames; the second half is darkened.
    pub frames: usize,
    /// Middle of the path, as a part of the photograph's width and height.
    pub centre: [f64; 2],
    /// Half the way across, in frame pixels, x and y.
    pub sweep: [f64; 2],
    /// Mean above black that the darkened half falls to, 1 = white.
    pub dark_mean: f64,
    /// The camera's own noise, for what attenuation takes away of it.
    pub noise: Noise,
}

/// Why there is no pan.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The photograph is too small for the path.
    #[error(
        "the pan needs {needed:?} frame pixels (columns, rows) around its centre, a sub-lattice of the photograph has {found:?}"
    )]
    Small {
        /// Frame pixels.
        needed: [usize; 2],
        /// Frame pixels.
        found: [usize; 2],
    },
    /// A setting that makes no sense.
    #[error("{what} is {found}, expected {expected}")]
    Setting {
        /// Which.
        what: &'static str,
        /// As given.
        found: String,
        /// What makes sense.
        expected: &'static str,
    },
}

/// A frame of the pan.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Raw counts, RGGB, with the photograph's own black and white level.
    pub counts: Vec<u16>,
    /// True flow of every pixel from the frame before, (u right, v down) in frame pixels; None for the first.
    pub pan: Option<[f64; 2]>,
    /// Column and row of the cells' sub-lattice.
    pub lattice: [usize; 2],
    /// 1 as shot; less is attenuated by this and noised on top.
    pub factor: f64,
}

/// The pan, frame by frame.
#[derive(Debug, Clone)]
pub struct Pan {
    photograph: Photograph,
    settings: Settings,
    mean: f64,
    index: usize,
    /// Where the frame before began in the photograph, in frame pixels: a Bayer cell of the photograph is one wide.
    before: Option<[usize; 2]>,
}

impl Pan {
    /// Checks that the path stays inside.
    pub fn new(photograph: Photograph, settings: Settings) -> Result<Pan, Error> {
        let Photograph { width, height, counts, black, white } = &photograph;
        if counts.len() != width * height {
            return Err(Error::Setting {
                what: "counts", found: counts.len().to_string(), expected: "width × height"
            });
        }
        if settings.size.iter().any(|side| side % 2 == 1 || *side == 0) || settings.frames < 2 {
            let found = format!("{:?}, {} frames", settings.size, settings.frames);
            return Err(Error::Setting { what: "size", found, expected: "even columns and rows, two frames at least" });
        }
        // One frame pixel is one cell of the photograph.
        let found = [width / 2, height / 2];
        let needed: [usize; 2] = std::array::from_fn(|i| settings.size[i] + 2 * (settings.sweep[i].abs() as usize + 4));
        let room = |i: usize| settings.centre[i].min(1.0 - settings.centre[i]) * 2.0 * found[i] as f64;
        if (0..2).any(|i| (needed[i] as f64) > room(i)) {
            return Err(Error::Small { needed, found });
        }
        // What the path passes over, in cells; the rest of the photograph may be much brighter.
        let from: [usize; 2] = std::array::from_fn(|i| (settings.centre[i] * found[i] as f64) as usize - needed[i] / 2);
        let seen = (2 * from[1]..2 * (from[1] + needed[1])).flat_map(|row| {
            let begin = row * width + 2 * from[0];
            &counts[begin..begin + 2 * needed[0]]
        });
        let sum: f64 = seen.map(|c| f64::from(*c) - black).sum();
        let mean = sum / (4 * needed[0] * needed[1]) as f64 / (white - black);
        if !(1e-5..mean).contains(&settings.dark_mean) {
            let found = settings.dark_mean.to_string();
            return Err(Error::Setting {
                what: "dark_mean",
                found,
                expected: "less than the mean of what is panned over",
            });
        }
        Ok(Pan { photograph, settings, mean, index: 0, before: None })
    }

    /// Mean above black of what the path passes over, 1 = white.
    pub fn mean(&self) -> f64 {
        self.mean
    }

    /// Where the smooth path wants the frame's corner, in cells of the photograph.
    fn wanted(&self) -> [f64; 2] {
        let phase = TAU * self.index as f64 / self.settings.frames as f64;
        let sway = [phase.sin(), (1.5 * phase + 0.6).sin()];
        let whole = [self.photograph.width / 2, self.photograph.height / 2];
        std::array::from_fn(|i| {
            let middle = self.settings.centre[i] * whole[i] as f64 - self.settings.size[i] as f64 / 2.0;
            middle + self.settings.sweep[i] * sway[i]
        })
    }

    /// The whole cell nearest to the path whose sub-lattice is not that of the frame before.
    fn corner(&self) -> [usize; 2] {
        let [x, y] = self.wanted();
        let mut best = (f64::INFINITY, [0, 0]);
        for (dx, dy) in (-1..=2).flat_map(|dx| (-1..=2).map(move |dy| (dx, dy))) {
            let at = [x.floor() + f64::from(dx), y.floor() + f64::from(dy)];
            let corner = at.map(|side| side.max(0.0) as usize);
            let same = self.before.is_some_and(|before| (0..2).all(|i| before[i] % 2 == corner[i] % 2));
            let away = (at[0] - x).hypot(at[1] - y);
            if !same && away < best.0 {
                best = (away, corner);
            }
        }
        best.1
    }

    /// The first half is as shot; then the light falls over a quarter of the second half and stays.
    fn factor(&self) -> f64 {
        let half = self.settings.frames / 2;
        let part = (self.index + 1).saturating_sub(half) as f64 / (half as f64 / 4.0).max(1.0);
        if self.index < half { 1.0 } else { (self.settings.dark_mean / self.mean).powf(part.min(1.0)) }
    }

    fn dimmed(&self, shot: u16, colour: usize, factor: f64, rest: &Noise, draws: &mut Normals) -> u16 {
        if factor >= 1.0 {
            return shot;
        }
        let Photograph { black, white, .. } = self.photograph;
        let dim = factor * (f64::from(shot) - black) / (white - black);
        let value = rest.gaussian(colour, dim, draws);
        (black + value * (white - black)).round().clamp(0.0, white) as u16
    }
}

impl Iterator for Pan {
    type Item = View;

    fn next(&mut self) -> Option<View> {
        if self.index >= self.settings.frames {
            return None;
        }
        let corner = self.corner();
        let factor = self.factor();
        let rest = self.settings.noise.darkening(factor);
        let [columns, rows] = self.settings.size;
        let mut counts = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            let mut draws = Normals::new(self.settings.seed ^ 0x9a4, (self.index * 65_536 + row) as u64);
            for column in 0..columns {
                // Cell (column / 2) of the window is every second cell of the photograph, from the corner on.
                let cell = [corner[0] + column / 2 * 2, corner[1] + row / 2 * 2];
                let at = (2 * cell[1] + row % 2) * self.photograph.width + 2 * cell[0] + column % 2;
                let colour = row % 2 + column % 2;
                counts.push(self.dimmed(self.photograph.counts[at], colour, factor, &rest, &mut draws));
            }
        }
        // The window moves right, what it shows moves left.
        let pan = self.before.map(|before| std::array::from_fn(|i| before[i] as f64 - corner[i] as f64));
        self.before = Some(corner);
        self.index += 1;
        Some(View { counts, pan, lattice: corner.map(|side| side % 2), factor })
    }
}
