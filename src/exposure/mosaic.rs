//! A frame's counts as they stand, for whoever looks at the sensor and not at the picture.

use super::{Config, Error, Pattern, layout::Layout, rows};
use crate::wire::Image;

/// The counts of one frame, low-justified.
#[derive(Debug, Clone, PartialEq)]
pub struct Mosaic {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height` × `width`.
    pub counts: Vec<u16>,
    /// `None` is monochrome.
    pub pattern: Option<Pattern>,
    /// Counts without light, at the four places of a cell: the first row's two, then the second's.
    pub black: [f32; 4],
    /// Counts of a full pixel.
    pub white: f32,
}

/// The pixels of one colour.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    /// `R`, `G1` (beside red), `G2` (beside blue), `B`; or `mono`.
    pub name: &'static str,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height` × `width`, black off and white 1: below black is negative.
    pub values: Vec<f32>,
    /// The value of count 0: the sensor can give no less.
    pub lowest: f32,
}

impl Mosaic {
    /// Reads an image as the settings declare it.
    pub fn read(config: &Config, image: &Image) -> Result<Self, Error> {
        config.check()?;
        let layout = Layout::read(config, image)?;
        let mut counts = vec![0; layout.width * layout.height];
        for (y, row) in counts.chunks_exact_mut(layout.width).enumerate() {
            rows::read(&layout, layout.row(&image.data, y), row);
            rows::shift_down(row, layout.shift());
        }
        let Layout { width, height, pattern, black, white, .. } = layout;
        Ok(Self { width, height, counts, pattern, black: [black; 4], white })
    }

    /// Red, the green beside red, the green beside blue, and blue; one plane where there are no colours.
    pub fn planes(&self) -> Vec<Plane> {
        let Some(pattern) = self.pattern else { return vec![self.plane("mono", 0, 1)] };
        // Places of R, G1, G2 and B in a cell.
        let places = match pattern {
            Pattern::Rggb => [0, 1, 2, 3],
            Pattern::Grbg => [1, 0, 3, 2],
            Pattern::Gbrg => [2, 3, 0, 1],
            Pattern::Bggr => [3, 2, 1, 0],
        };
        ["R", "G1", "G2", "B"].into_iter().zip(places).map(|(name, place)| self.plane(name, place, 2)).collect()
    }

    fn plane(&self, name: &'static str, place: usize, stride: usize) -> Plane {
        let (width, height) = (self.width / stride, self.height / stride);
        let black = self.black[place];
        let span = self.white - black;
        let rows = self.counts.chunks_exact(self.width).skip(place / 2).step_by(stride).take(height);
        let pixels = rows.flat_map(|row| row.iter().skip(place % 2).step_by(stride).take(width));
        let values = pixels.map(|count| (f32::from(*count) - black) / span).collect();
        Plane { name, width, height, values, lowest: -black / span }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pattern_gives_its_colours() {
        // 10 red, 20 the green beside it, 30 the green beside blue, 40 blue; each cell one more than the cell before.
        for (pattern, cell) in [
            (Pattern::Rggb, [10, 20, 30, 40]),
            (Pattern::Grbg, [20, 10, 40, 30]),
            (Pattern::Gbrg, [30, 40, 10, 20]),
            (Pattern::Bggr, [40, 30, 20, 10]),
        ] {
            let (width, height) = (5, 4);
            let at = |i: usize| cell[i / width % 2 * 2 + i % width % 2] + (i / width / 2 * 2 + i % width / 2) as u16;
            let counts = (0..width * height).map(at).collect();
            let mosaic = Mosaic { width, height, counts, pattern: Some(pattern), black: [10.0; 4], white: 110.0 };
            for (plane, first) in mosaic.planes().iter().zip([0.0_f32, 0.1, 0.2, 0.3]) {
                assert_eq!((plane.width, plane.height, plane.lowest), (2, 2, -0.1));
                let expected = [0.0, 0.01, 0.02, 0.03].map(|step| first + step);
                assert!(
                    plane.values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6),
                    "{pattern} {} {:?}",
                    plane.name,
                    plane.values
                );
            }
        }
    }
}
