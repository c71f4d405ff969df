//! Hot pixels: lone pixels far above the noise take the median of their neighbours of the same colour.
//!
//! A pixel is hot when all of this holds, so that neither noise nor a lamp is ever taken for one:
//! 1. It stands above the brightest of its eight nearest neighbours of the same colour by more than the threshold
//!    times the row's mean absolute difference between same-colour neighbours, and by more than [`FLOOR`] counts. Under
//!    Gaussian noise the mean absolute difference is 1.13 standard deviations.
//! 2. It does so by more than twice the spread of those eight as well, for where noise grows with the signal.
//! 3. It is alone: a lamp's image is wider than a pixel and lifts the pixels beside it, whatever their colour. Their
//!    rise over pixels of their own colour further away must stay below an eighth of the pixel's, plus twice the noise.
//!
//! Only counts as they came are looked at, never repaired ones, so that the order of repair does not matter.

use super::{
    layout::Layout,
    rows::{self, Found, STRETCH},
};

/// Counts that a hot pixel must stand out by at least, for images with less noise than their own quantisation.
pub(super) const FLOOR: u32 = 4;

/// Repairs the row `y` in `counts`; true when it changed. `found` is the row's own measure, shifted down.
pub(super) fn repair(
    layout: &Layout,
    bytes: &[u8],
    y: usize,
    counts: &mut [u16],
    found: Found,
    threshold: f32,
) -> bool {
    let (width, stride) = (layout.width, layout.stride());
    if threshold <= 0.0 || width < 5 || layout.height < 5 {
        return false;
    }
    let noise = found.differences as f32 / (width - stride) as f32;
    let above = ((threshold * noise) as u32).max(FLOOR);
    if u32::from(found.max) <= above {
        return false;
    }
    let above = above as u16;
    let mut changed = false;
    // Repaired pixels are only ever lowered, so that among them the screen can find too many suspects but never too
    // few; judged they are by the counts as they came.
    let mut look = |counts: &mut [u16], pixels: std::ops::Range<usize>| {
        for x in pixels {
            let left = counts[if x < stride { x + stride } else { x - stride }];
            let right = counts[if x + stride < width { x + stride } else { x - stride }];
            if counts[x].saturating_sub(left.max(right)) > above
                && let Some(repaired) = judge(&Window { layout, bytes, x, y }, above, noise)
            {
                counts[x] = repaired;
                changed = true;
            }
        }
    };
    if width < STRETCH + 2 * stride {
        look(counts, 0..width);
        return changed;
    }
    let mut from = stride;
    while let Some(suspect) = rows::next_suspect(counts, stride, above, from) {
        look(counts, suspect..suspect + STRETCH);
        from = suspect + STRETCH;
    }
    look(counts, 0..stride);
    look(counts, width - stride..width);
    changed
}

/// The counts around a pixel, mirrored at the image's edges in such a way that colours are kept.
struct Window<'a> {
    layout: &'a Layout,
    bytes: &'a [u8],
    x: usize,
    y: usize,
}

impl Window<'_> {
    fn at(&self, right: isize, down: isize) -> u16 {
        let mirror = |middle: usize, by: isize, size: usize| {
            let to = middle as isize + by;
            if (0..size as isize).contains(&to) { to as usize } else { (middle as isize - by) as usize }
        };
        let (x, y) = (mirror(self.x, right, self.layout.width), mirror(self.y, down, self.layout.height));
        self.layout.count(self.bytes, x, y)
    }

    fn brightest(&self, of: &[(isize, isize)]) -> u32 {
        of.iter().map(|&(right, down)| u32::from(self.at(right, down))).max().unwrap_or(0)
    }
}

/// What the pixel should be, if it is hot.
fn judge(window: &Window, above: u16, noise: f32) -> Option<u16> {
    let stride = window.layout.stride() as isize;
    let count = u32::from(window.at(0, 0));
    let beside = window.brightest(&[(-stride, 0), (stride, 0)]);
    if count <= beside + u32::from(above) {
        return None;
    }
    let ring = [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];
    let mut around = ring.map(|(right, down)| window.at(right * stride, down * stride));
    around.sort_unstable();
    let [darkest, .., brightest] = around.map(u32::from);
    let median = (u32::from(around[3]) + u32::from(around[4])).div_ceil(2);
    if count <= brightest + u32::from(above).max(2 * (brightest - darkest)) {
        return None;
    }
    let rows = window.brightest(&[(-1, 0), (1, 0)]);
    let rows_beside = window.brightest(&[(-1, -2), (1, -2), (-1, 2), (1, 2)]);
    let columns = window.brightest(&[(0, -1), (0, 1)]);
    let columns_beside = window.brightest(&[(-2, -1), (2, -1), (-2, 1), (2, 1)]);
    let rise = rows.saturating_sub(rows_beside).max(columns.saturating_sub(columns_beside));
    let alone = rise as f32 <= (count - brightest) as f32 / 8.0 + 2.0 * noise;
    alone.then_some(median as u16)
}
