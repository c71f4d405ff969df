//! The mosaic's rows become a smaller linear image: cells to RGB, then every output pixel the exact mean of its area.
//!
//! Rows are first summed downwards, column by column, and only a finished band is summed sideways, so that nearly all
//! work runs along contiguous memory. Where the reduction is by a whole factor, the sums are integers and exact; else
//! they are weighted by the part of each cell that lies in the output pixel. Both orders of summation are fixed.

use super::{Pattern, layout::Layout, sums};

/// Sizes that follow from the camera's and from the width asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Plan {
    /// Pixels of a cell's side: 2 for a mosaic, 1 for monochrome.
    pub cell: usize,
    /// Whole cells, across and down.
    pub cells: [usize; 2],
    /// Columns and rows of the developed image.
    pub size: [usize; 2],
    /// Cells a pixel in both directions, where that is one whole number small enough to sum in 32 bits.
    pub whole: Option<usize>,
}

/// Up to this factor, the sum of a 16-bit area fits 32 bits with room.
const WHOLE_MAX: usize = 64;

impl Plan {
    pub fn new(layout: &Layout, width_max: usize) -> Self {
        let cell = layout.stride();
        let cells = [layout.width / cell, layout.height / cell];
        let width = cells[0].min(width_max);
        // Rounded to the nearest, so that the aspect is kept as well as whole pixels allow.
        let height = ((2 * cells[1] * width + cells[0]) / (2 * cells[0])).clamp(1, cells[1]);
        let whole = cells[0] / width;
        let fits = cells == [width * whole, height * whole] && whole <= WHOLE_MAX;
        Self { cell, cells, size: [width, height], whole: fits.then_some(whole) }
    }

    /// Camera pixels a developed pixel, x and y.
    pub fn scale(&self) -> [f32; 2] {
        std::array::from_fn(|i| (self.cells[i] * self.cell) as f32 / self.size[i] as f32)
    }

    /// Columns of the mosaic that are used.
    pub fn columns(&self) -> usize {
        self.cells[0] * self.cell
    }

    /// Rows of the mosaic that are used.
    pub fn rows(&self) -> usize {
        self.cells[1] * self.cell
    }
}

/// Where the developed rows go.
pub(super) struct Target<'a> {
    /// Three planes, before the gain.
    pub reduced: &'a mut [f32],
    /// One plane.
    pub saturated: &'a mut [u8],
}

/// Sums under way, and the memory for them.
#[derive(Debug)]
pub(super) struct Reducer {
    pub plan: Plan,
    pattern: Option<Pattern>,
    black: f32,
    span: f32,
    white: u16,
    /// Even and odd rows of a band, by a whole factor.
    sums: [Vec<u32>; 2],
    /// The same weighted, for the two bands that a cell can lie in.
    weighted: [[Vec<f32>; 2]; 2],
    /// Largest count of each column, for the same two bands, and whether any is at white.
    peaks: [Vec<u16>; 2],
    peaked: [bool; 2],
    /// First cell and number of cells of each output column, and their weights end to end.
    taps: Vec<[u32; 2]>,
    weights: Vec<f32>,
    cells: Vec<[f32; 4]>,
    /// The output row that is under way.
    row: usize,
    /// Sums over the finished rows of each plane.
    totals: [f64; 3],
}

impl Reducer {
    pub fn new(layout: &Layout, plan: Plan) -> Self {
        let columns = plan.columns();
        let (whole, mixed) = if plan.whole.is_some() { (columns, 0) } else { (0, columns) };
        let mut reducer = Self {
            plan,
            pattern: layout.pattern,
            black: 0.0,
            span: 1.0,
            white: u16::MAX,
            sums: std::array::from_fn(|_| vec![0; whole]),
            weighted: std::array::from_fn(|_| std::array::from_fn(|_| vec![0.0; mixed])),
            peaks: std::array::from_fn(|_| vec![0; columns]),
            peaked: [false; 2],
            taps: Vec::new(),
            weights: Vec::new(),
            cells: vec![[0.0; 4]; mixed / plan.cell],
            row: 0,
            totals: [0.0; 3],
        };
        if plan.whole.is_none() {
            reducer.weigh_columns();
        }
        reducer
    }

    fn weigh_columns(&mut self) {
        let ([cells, _], [width, _]) = (self.plan.cells, self.plan.size);
        for x in 0..width {
            let first = x * cells / width;
            let end = ((x + 1) * cells).div_ceil(width);
            self.taps.push([first as u32, (end - first) as u32]);
            self.weights.extend((first..end).map(|cell| share(cell, cells, x, width)));
        }
    }

    /// Readies the sums for a frame.
    pub fn start(&mut self, layout: &Layout) {
        self.pattern = layout.pattern;
        self.black = layout.black;
        self.span = layout.white - layout.black;
        self.white = layout.white.ceil() as u16;
        self.row = 0;
        self.totals = [0.0; 3];
        self.peaked = [false; 2];
        self.sums.iter_mut().for_each(|sums| sums.fill(0));
        self.weighted.iter_mut().flatten().for_each(|sums| sums.fill(0.0));
        self.peaks.iter_mut().for_each(|peaks| peaks.fill(0));
    }

    /// Takes the mosaic's row `y`, in order, and writes the output rows that it completes.
    pub fn take(&mut self, y: usize, counts: &[u16], max: u16, target: &mut Target) {
        let ([_, cells], [_, height]) = (self.plan.cells, self.plan.size);
        let (cell, parity) = (y / self.plan.cell, y % self.plan.cell);
        let counts = &counts[..self.plan.columns()];
        // A cell is never larger than an output pixel, so it lies in one band or across the border of two.
        let bands = cell * height / cells..=((cell + 1) * height - 1) / cells;
        if self.plan.whole.is_some() {
            sums::add(&mut self.sums[parity], counts);
        } else {
            for band in bands.clone() {
                let weight = share(cell, cells, band, height);
                sums::add_weighted(&mut self.weighted[band % 2][parity], counts, self.black, weight);
            }
        }
        if max >= self.white {
            for band in bands {
                self.peaked[band % 2] = true;
                sums::raise(&mut self.peaks[band % 2], counts);
            }
        }
        if parity + 1 == self.plan.cell && (cell + 1) * height >= (self.row + 1) * cells {
            self.finish_row(target);
        }
    }

    fn finish_row(&mut self, target: &mut Target) {
        let [width, height] = self.plan.size;
        let here = self.row * width..(self.row + 1) * width;
        let (red, rest) = target.reduced.split_at_mut(width * height);
        let (green, blue) = rest.split_at_mut(width * height);
        let planes = [&mut red[here.clone()], &mut green[here.clone()], &mut blue[here.clone()]];
        match self.pattern {
            None => self.finish_mono(planes),
            Some(pattern) => self.finish_mosaic(pattern, planes),
        }
        for (total, plane) in self.totals.iter_mut().zip([&*red, &*green, &*blue]) {
            *total += sums::total(&plane[here.clone()]);
        }
        let band = self.row % 2;
        let saturated = &mut target.saturated[here];
        saturated.fill(0);
        if std::mem::take(&mut self.peaked[band]) {
            self.mark(band, saturated);
            self.peaks[band].fill(0);
        }
        self.sums.iter_mut().for_each(|sums| sums.fill(0));
        self.weighted[band].iter_mut().for_each(|sums| sums.fill(0.0));
        self.row += 1;
    }

    fn finish_mono(&self, [red, green, blue]: [&mut [f32]; 3]) {
        match self.plan.whole {
            Some(factor) => sums::whole_mono(factor, &self.sums[0], [self.black, self.span], red),
            None => sums::mixed_mono(&self.weighted[self.row % 2][0], &self.taps, &self.weights, self.span, red),
        }
        green.copy_from_slice(red);
        blue.copy_from_slice(red);
    }

    fn finish_mosaic(&mut self, pattern: Pattern, [red, green, blue]: [&mut [f32]; 3]) {
        // Every pattern is RGGB with its rows swapped, its outer colours swapped, or both.
        let (top, outer) = match pattern {
            Pattern::Rggb => (0, [red, blue]),
            Pattern::Bggr => (0, [blue, red]),
            Pattern::Gbrg => (1, [red, blue]),
            Pattern::Grbg => (1, [blue, red]),
        };
        let [first, second] = outer;
        let planes = [first, green, second];
        if let Some(factor) = self.plan.whole {
            let rows = [&self.sums[top][..], &self.sums[1 - top]];
            sums::whole_cells(factor, rows, [self.black, self.span], planes);
        } else {
            let sums = &self.weighted[self.row % 2];
            sums::join_cells([&sums[top], &sums[1 - top]], &mut self.cells);
            sums::mixed_cells(&self.cells, &self.taps, &self.weights, self.span, planes);
        }
    }

    fn mark(&self, band: usize, saturated: &mut [u8]) {
        let ([cells, _], [width, _]) = (self.plan.cells, self.plan.size);
        for (x, mark) in saturated.iter_mut().enumerate() {
            let first = x * cells / width * self.plan.cell;
            let end = ((x + 1) * cells).div_ceil(width) * self.plan.cell;
            *mark = u8::from(self.peaks[band][first..end].iter().any(|peak| *peak >= self.white));
        }
    }

    /// Means of the three planes of the whole image, black off and white 1.
    pub fn means(&self) -> [f64; 3] {
        let pixels = (self.plan.size[0] * self.plan.size[1]) as f64;
        self.totals.map(|total| total / pixels)
    }
}

/// The part of the output pixel `pixel` (of `pixels`) that the cell `cell` (of `cells`) makes up.
fn share(cell: usize, cells: usize, pixel: usize, pixels: usize) -> f32 {
    let from = (cell * pixels).max(pixel * cells);
    let to = ((cell + 1) * pixels).min((pixel + 1) * cells);
    to.saturating_sub(from) as f32 / cells as f32
}
