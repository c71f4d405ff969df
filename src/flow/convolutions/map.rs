//! Feature maps as the tiles read them: a pixel's channels side by side in bf16, whole lines of them, and a margin of zeros.

use super::tiles::{LANES, Line, SIDE};
use crate::flow::bands::{self, Bands};

/// A map. Its margin is never written to, so that a convolution finds zeros around the picture.
#[derive(Debug, Default)]
pub struct Map {
    lines: Vec<Line>,
    /// Channels.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Rows and columns of zeros on every side.
    pub margin: usize,
}

impl Map {
    /// Makes it so large; what was in it is gone if that is a change.
    pub fn resize(&mut self, [channels, height, width]: [usize; 3], margin: usize) {
        if [self.channels, self.height, self.width, self.margin] != [channels, height, width, margin] {
            (self.channels, self.height, self.width, self.margin) = (channels, height, width, margin);
            self.lines.clear();
            // A tile has 16 pixels also where a row has fewer, and reads beyond the last row then.
            let beyond = 2 * SIDE * self.depth();
            self.lines.resize((height + 2 * margin) * self.stride() + beyond, Line::ZERO);
        }
    }

    /// Lines of a pixel.
    pub fn depth(&self) -> usize {
        self.channels.div_ceil(LANES)
    }

    /// Lines of a row, its margins among them.
    pub fn stride(&self) -> usize {
        (self.width + 2 * self.margin) * self.depth()
    }

    /// Every line.
    pub fn lines(&self) -> &[Line] {
        &self.lines
    }

    /// Where the pixel so many rows and columns from the margin's first corner begins.
    pub fn at(&self, y: usize, x: usize) -> usize {
        y * self.stride() + x * self.depth()
    }

    /// A row's pixels.
    pub fn row(&self, y: usize) -> &[Line] {
        &self.lines[self.at(y + self.margin, self.margin)..][..self.width * self.depth()]
    }

    /// Rows of a band, and bands: even numbers of rows, for two are multiplied at once.
    pub fn bands(height: usize) -> (usize, usize) {
        let rows = height.div_ceil(BANDS).next_multiple_of(2);
        (rows, height.div_ceil(rows))
    }

    /// The picture's rows, margins left and right among them, in bands.
    pub fn cut(&mut self) -> Bands<'_, Line> {
        let (stride, margin, height) = (self.stride(), self.margin, self.height);
        let picture = &mut self.lines[margin * stride..][..height * stride];
        Bands::new(picture, [1, height, stride], Self::bands(height).0)
    }
}

/// About how many bands a picture is cut into: enough for a few threads, few enough that weights are not fetched for nothing.
const BANDS: usize = 8;
const _: () = assert!(BANDS <= bands::MOST);
