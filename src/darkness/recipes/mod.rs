//! Recipes that turn a clean bright pair into a dark one, as the paper's data set (FCDN) was made from FlyingChairs.
//!
//! A recipe draws its figures once a pair from (seed, pair), and fresh noise for each frame. Everything is by
//! arithmetic that rounds in one way only, so the bytes depend on the recipe, the seed, the number of the pair and the
//! frames, and on neither threads nor machine. The flow of a pair stays what it was.

mod authors;
mod paper;
mod plan;
mod unprocess;

use std::{fmt, str::FromStr};

use super::{
    gaussians::{Gaussians, mixed, splitmix},
    profiles::Profile,
};

/// How a clean pair becomes a dark one. A clean value y of 0…1 is what the frame's byte says of 255; noise is
/// independent from pixel to pixel, colour to colour and frame to frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Recipe {
    /// The paper's text: y = (byte/255)^γ with γ of 1.0…2.4 drawn for each colour, then z = y + N(0, a·y + b), clipped
    /// to 0…1 and rounded to a byte. Brightness is not reduced.
    ///
    /// a = r·a₀ and b = r²·b₀, where (a₀, b₀) are a real camera's at some ISO
    /// ([`profiles`](super::profiles), each colour its own) and r = 0.4/m is the gain that brings a raw of mean m to 0.4.
    /// First comes a noise level, so spread that the paper's table 1 comes out ([`TABLE`]), then a camera and ISO out of
    /// those that show such a level at some m of about 0.001…0.4, evenly, and m is solved for.
    Paper,
    /// The authors' released script (2021, MIT): on the 8-bit scale z = x + N(0, (a·x + b)²), a ~ |N(0, 19.5/255)| and
    /// b ~ |N(0, 38.25)|, cut to whole numbers of 0…255; then times 1/N(1, 0.05) for each colour, cut again. No gamma.
    /// Here a is a deviation by signal, b a deviation.
    Authors2021,
    /// Brooks et al., "Unprocessing Images for Learned Raw Denoising" (CVPR 2019): inverse smoothstep tone curve, power
    /// 2.2, a colour matrix of a random camera, white balance undone with highlights kept; then z = y + N(0, a·y + b)
    /// with ln a even over ln 0.0001…ln 0.012 and ln b = 2.18·ln a + 1.20 + N(0, 0.26²).
    ///
    /// Differs from theirs in that it stays RGB at full resolution (theirs ends in a Bayer mosaic of half the size), and
    /// that z is clipped to 0…1 and rounded to a byte.
    Unprocess,
}

/// Images by noise level in the paper's table 1 for FCDN: levels of 0–10, 10–20, 20–30 and above, on the 8-bit scale.
pub const TABLE: [u32; 4] = [17021, 14214, 14166, 343];

/// What was drawn for a pair; colours are red, green, blue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drawn {
    /// Noise by signal, in units of white: of the variance, but of the deviation for [`Recipe::Authors2021`].
    pub a: [f64; 3],
    /// Noise in the dark, in units of white squared: a variance, but a deviation (in units of white) for
    /// [`Recipe::Authors2021`].
    pub b: [f64; 3],
    /// Powers that undid the tone curve; 1 where none did.
    pub gamma: [f64; 3],
    /// Gains after that; 1 where there were none.
    pub gain: [f64; 3],
    /// The noise level of the older frame on the 8-bit scale, clipping counted, as Chen et al. 2015 estimate it: of the
    /// estimate it is right to about a twentieth, without its cost.
    pub level: f64,
    /// Whose noise it is, and the raw mean that it would be taken at ([`Recipe::Paper`] only).
    pub taken: Option<(Profile, f64)>,
}

/// Why nothing was made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// No such recipe.
    #[error("there is no recipe {0:?}; there are paper, authors-2021 and unprocess")]
    Recipe(String),
    /// Frames of a pair are equal in size.
    #[error(
        "the frames of a pair have {older} and {newer} bytes; expected as many of each, three a pixel, and at least one pixel"
    )]
    Frames {
        /// Bytes of the older frame.
        older: usize,
        /// Bytes of the newer frame.
        newer: usize,
    },
}

impl Recipe {
    /// Every recipe.
    pub const ALL: [Recipe; 3] = [Recipe::Paper, Recipe::Authors2021, Recipe::Unprocess];

    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Recipe::Paper => "paper",
            Recipe::Authors2021 => "authors-2021",
            Recipe::Unprocess => "unprocess",
        }
    }

    /// Turns a clean pair (interleaved RGB of 8 bits, frames of the same size) into a dark one, in place.
    ///
    /// Nothing is allocated. Pairs of one data set share the seed and differ in `pair`.
    pub fn darken(self, seed: u64, pair: u64, older: &mut [u8], newer: &mut [u8]) -> Result<Drawn, Error> {
        if older.len() != newer.len() || older.is_empty() || !older.len().is_multiple_of(3) {
            return Err(Error::Frames { older: older.len(), newer: newer.len() });
        }
        let mut dice = Dice::new(seed, pair);
        let (plan, drawn) = match self {
            Recipe::Paper => paper::plan(&mut dice, older),
            Recipe::Authors2021 => authors::plan(&mut dice, older),
            Recipe::Unprocess => unprocess::plan(&mut dice, older),
        };
        for (frame, number) in [(older, 0), (newer, 1)] {
            plan.develop(&mut Gaussians::new(seed, [pair, number]), frame);
        }
        Ok(drawn)
    }
}

impl fmt::Display for Recipe {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Recipe {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        let found = Recipe::ALL.into_iter().find(|recipe| recipe.name() == name);
        found.ok_or_else(|| Error::Recipe(name.into()))
    }
}

/// The golden ratio's fractional part as a 64-bit fraction: multiples of it lie more evenly than of any other.
const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// A 64-bit fraction, 0…1 without 1.
fn part(fraction: u64) -> f64 {
    (fraction >> 11) as f64 / (1_u64 << 53) as f64
}

/// What a pair's figures are drawn from.
struct Dice {
    turn: u64,
    even: u64,
    normals: [f32; 16],
    used: usize,
}

impl Dice {
    fn new(seed: u64, pair: u64) -> Self {
        let mut normals = [0.0; 16];
        Gaussians::new(seed, [pair, 2]).fill(&mut normals);
        let turn = mixed(&[seed, 4]).wrapping_add(pair.wrapping_mul(GOLDEN));
        Self { turn, even: mixed(&[seed, pair, 3]), normals, used: 0 }
    }

    /// A part of 0…1 that depends on the pair's number so that pairs in a row fill 0…1 evenly, however few they are.
    fn in_turn(&self) -> f64 {
        part(self.turn)
    }

    /// Even over low…high.
    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * part(splitmix(&mut self.even))
    }

    /// N(0, 1).
    fn normal(&mut self) -> f64 {
        let drawn = self.normals[self.used % self.normals.len()];
        self.used += 1;
        f64::from(drawn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recipe_has_one_name() {
        for recipe in Recipe::ALL {
            assert_eq!(recipe.to_string().parse(), Ok(recipe));
        }
        assert_eq!(
            Recipe::from_str("authors").unwrap_err().to_string(),
            "there is no recipe \"authors\"; there are paper, authors-2021 and unprocess"
        );
    }

    #[test]
    fn frames_that_are_no_pair_are_refused() {
        for (older, newer) in [(0, 0), (3, 6), (4, 4)] {
            let refused = Recipe::Paper.darken(1, 1, &mut vec![0; older], &mut vec![0; newer]);
            assert_eq!(refused, Err(Error::Frames { older, newer }));
        }
    }
}
