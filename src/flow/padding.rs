//! Sizes: images of any size are padded by reflection for the network, and its quarter raster is cut or enlarged back.

use crate::exposure::Exposed;

/// Sides of a network's images are multiples of this where it does not say less: six halvings.
pub const STRIDE: usize = 64;

/// The smallest multiple of `stride` that holds `length`.
pub fn padded(length: usize, stride: usize) -> usize {
    length.div_ceil(stride).max(1) * stride
}

/// Where index `i` of an endlessly reflected line of `length` points reads: 0 1 2 1 0 1 2 … (the edge is not repeated).
pub fn reflected(i: usize, length: usize) -> usize {
    if length < 2 {
        return 0;
    }
    let period = 2 * (length - 1);
    let i = i % period;
    if i < length { i } else { period - i }
}

/// A developed image as the network takes it: continued to the right and downwards by reflection.
///
/// Reflection keeps the statistics of the image, which the network normalises by, and makes no edge.
#[derive(Debug, Clone, Copy)]
pub struct Padded<'a> {
    /// The image itself.
    pub exposed: &'a Exposed,
    /// Columns with the padding.
    pub width: usize,
    /// Rows with the padding.
    pub height: usize,
}

impl<'a> Padded<'a> {
    /// `exposed`, continued to multiples of `stride`.
    pub fn new(exposed: &'a Exposed, stride: usize) -> Self {
        Self { exposed, width: padded(exposed.width, stride), height: padded(exposed.height, stride) }
    }

    /// Whether the image needs no padding.
    pub fn is_whole(&self) -> bool {
        self.width == self.exposed.width && self.height == self.exposed.height
    }

    /// Writes the planar image, 3 × `height` × `width`, over all of `into`.
    pub fn write(&self, into: &mut [f32]) {
        let (from_width, from_height) = (self.exposed.width, self.exposed.height);
        if self.is_whole() {
            into.copy_from_slice(&self.exposed.rgb);
            return;
        }
        let planes = self.exposed.rgb.chunks_exact(from_width * from_height);
        for (plane, target) in planes.zip(into.chunks_exact_mut(self.width * self.height)) {
            for (y, row) in target.chunks_exact_mut(self.width).enumerate() {
                let from = &plane[reflected(y, from_height) * from_width..][..from_width];
                let (inside, outside) = row.split_at_mut(from_width);
                inside.copy_from_slice(from);
                for (x, value) in outside.iter_mut().enumerate() {
                    *value = from[reflected(from_width + x, from_width)];
                }
            }
        }
    }
}

/// Cuts the upper left `width` × `height` cells of `channels` interleaved values out of rows of `from_width` cells.
pub fn crop(from: &[f32], from_width: usize, into: &mut [f32], width: usize, channels: usize) {
    let rows = from.chunks_exact(from_width * channels);
    for (row, target) in rows.zip(into.chunks_exact_mut(width * channels)) {
        target.copy_from_slice(&row[..width * channels]);
    }
}

/// The two cells that a pixel of the fourfold finer raster lies between, and the weight of the second.
///
/// Pixel p is cell (p + 0.5) / 4 − 0.5. Beyond the first and last cell's centre the raster is continued flat.
fn between(pixel: usize, cells: usize) -> (usize, usize, f32) {
    let place = (pixel as f32 + 0.5) / 4.0 - 0.5;
    let first = place.floor();
    let weight = place - first;
    let last = cells as isize - 1;
    let clamp = |i: isize| i.clamp(0, last) as usize;
    (clamp(first as isize), clamp(first as isize + 1), weight)
}

/// Enlarges a raster of `from_width` × `from_height` cells fourfold by bilinear interpolation, and cuts it to `width`
/// columns and as many rows as `into` holds. Half-pixel-exact: a linear field stays the same linear field.
pub fn enlarge(
    from: &[f32],
    (from_width, from_height): (usize, usize),
    into: &mut [f32],
    width: usize,
    channels: usize,
) {
    let columns: Vec<_> = (0..width).map(|x| between(x, from_width)).collect();
    let length = from_width * channels;
    // A row between two rows of the raster, from which the columns are then taken.
    let mut line = vec![0.0; length];
    for (y, target) in into.chunks_exact_mut(width * channels).enumerate() {
        let (upper, lower, down) = between(y, from_height);
        let rows = from[upper * length..][..length].iter().zip(&from[lower * length..][..length]);
        for (value, (a, b)) in line.iter_mut().zip(rows) {
            *value = a + down * (b - a);
        }
        for (cell, &(left, right, along)) in target.chunks_exact_mut(channels).zip(&columns) {
            let (a, b) = (&line[left * channels..][..channels], &line[right * channels..][..channels]);
            for ((value, a), b) in cell.iter_mut().zip(a).zip(b) {
                *value = a + along * (b - a);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize) -> Exposed {
        let rgb = (0..3 * width * height).map(|i| ((i * 7919) % 1009) as f32 / 1009.0).collect();
        Exposed { width, height, rgb, ..Exposed::default() }
    }

    /// Reflection said the slow way: walk to and fro.
    fn walked(steps: usize, length: usize) -> usize {
        let (mut at, mut forward) = (0, true);
        for _ in 0..steps {
            if length == 1 {
                return 0;
            }
            if at == length - 1 {
                forward = false;
            } else if at == 0 {
                forward = true;
            }
            if forward { at += 1 } else { at -= 1 }
        }
        at
    }

    #[test]
    fn padding_is_reflection_at_every_size() {
        for (width, height) in [(64, 64), (65, 63), (40, 30), (1, 1), (2, 3), (31, 130), (128, 5)] {
            let image = picture(width, height);
            let view = Padded::new(&image, 64);
            assert_eq!((view.width % 64, view.height % 64), (0, 0));
            assert!(view.width >= width && view.width < width + 64 && view.height >= height);
            let mut got = vec![f32::NAN; 3 * view.width * view.height];
            view.write(&mut got);
            for c in 0..3 {
                for y in 0..view.height {
                    for x in 0..view.width {
                        let want = image.rgb[(c * height + walked(y, height)) * width + walked(x, width)];
                        assert_eq!(got[(c * view.height + y) * view.width + x], want, "{width}x{height}: {c} {y} {x}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_crop_keeps_the_upper_left_cells() {
        let from: Vec<f32> = (0..5 * 4 * 2).map(|i| i as f32).collect();
        let mut into = vec![0.0; 3 * 2 * 2];
        crop(&from, 5, &mut into, 3, 2);
        assert_eq!(into, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0]);
    }

    #[test]
    fn a_linear_field_stays_linear_when_enlarged() {
        // Values at cell centres of a field over pixels: cell i stands at pixel 4 i + 1.5.
        let field = |x: f32, y: f32| [0.5 * x - 0.25 * y + 3.0, -0.125 * x + y];
        let (columns, rows) = (16, 12);
        let mut from = Vec::new();
        for row in 0..rows {
            for column in 0..columns {
                from.extend(field(4.0 * column as f32 + 1.5, 4.0 * row as f32 + 1.5));
            }
        }
        let (width, height) = (61, 45);
        let mut into = vec![f32::NAN; width * height * 2];
        enlarge(&from, (columns, rows), &mut into, width, 2);
        for y in 0..height {
            for x in 0..width {
                // Flat beyond the outermost centres, as the contract of the function says.
                let inside = |at: usize, cells: usize| (at as f32).clamp(1.5, 4.0 * cells as f32 - 2.5);
                let want = field(inside(x, columns), inside(y, rows));
                let got = &into[(y * width + x) * 2..][..2];
                assert!(
                    (got[0] - want[0]).abs() < 1e-4 && (got[1] - want[1]).abs() < 1e-4,
                    "{x} {y}: {got:?} {want:?}"
                );
            }
        }
    }
}
