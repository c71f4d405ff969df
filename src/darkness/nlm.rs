//! Non-local means with the meaning of OpenCV's `fastNlMeansDenoisingColored`, one box filter a shift.
//!
//! Buades, Coll and Morel 2005: every pixel becomes the mean of the pixels around it, each weighted by how alike the
//! squares around the two are, exp(−d²/h²). OpenCV does so apart for L and for (a, b) of CIE Lab, in whole numbers,
//! and its integers are kept to here, so that the planes come out the same to the bit; the way back from Lab is in
//! floating point, which was measured to be off by two bytes at most and by 0.05 in the mean.

use rayon::prelude::*;

use super::{enhance::mirrored, picture::Picture};

/// How far and how strongly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Strength for lightness, on the scale of its bytes.
    pub h: f64,
    /// Strength for colour.
    pub h_colour: f64,
    /// Side of the squares that are compared.
    pub template: usize,
    /// Side of the square that is searched.
    pub search: usize,
}

impl Default for Settings {
    /// OpenCV's usual values with h 10 for both, as the paper has them.
    fn default() -> Self {
        Self { h: 10.0, h_colour: 10.0, template: 7, search: 21 }
    }
}

/// Rows that one task works on; its own rows are few beside the template's rows above and below, but fit a cache.
const STRIP: usize = 32;

/// The denoised picture.
pub fn coloured(frame: &Picture, settings: &Settings) -> Picture {
    let (width, height) = (frame.width, frame.height);
    let [lightness, a, b] = to_lab(&frame.rgb);
    let lightness = denoise([&lightness], width, height, settings.h, settings);
    let colour = denoise([&a, &b], width, height, settings.h_colour, settings);
    Picture { width, height, rgb: from_lab(&lightness[0], &colour[0], &colour[1]) }
}

/// Denoises planes that are compared together.
pub fn denoise<const N: usize>(
    planes: [&[u8]; N],
    width: usize,
    height: usize,
    h: f64,
    settings: &Settings,
) -> [Vec<u8>; N] {
    let search = Search::new(planes, width, height, h, settings);
    let mut strips: Vec<[Vec<u8>; N]> = Vec::new();
    (0..height.div_ceil(STRIP)).into_par_iter().map(|strip| search.strip(strip * STRIP)).collect_into_vec(&mut strips);
    let mut whole = [(); N].map(|()| Vec::with_capacity(width * height));
    for strip in strips {
        for (plane, rows) in whole.iter_mut().zip(strip) {
            plane.extend(rows);
        }
    }
    whole
}

struct Search<const N: usize> {
    /// The planes, reflected outwards by `border`.
    planes: [Vec<u8>; N],
    width: usize,
    height: usize,
    wide: usize,
    border: usize,
    template: usize,
    search: usize,
    shift: u32,
    /// Weight by summed squares >> `shift`; the last, 0, stands for all beyond.
    weights: Vec<u32>,
}

impl<const N: usize> Search<N> {
    fn new(planes: [&[u8]; N], width: usize, height: usize, h: f64, settings: &Settings) -> Self {
        let (template, search) = (settings.template / 2, settings.search / 2);
        let border = template + search;
        let wide = width + 2 * border;
        let columns: Vec<usize> = (0..wide).map(|x| mirrored(x as isize - border as isize, width)).collect();
        let planes = planes.map(|plane| {
            let row = |y: usize| {
                let from = &plane[mirrored(y as isize - border as isize, height) * width..][..width];
                columns.iter().map(move |&x| from[x])
            };
            (0..height + 2 * border).flat_map(row).collect()
        });
        let area = (2 * template + 1).pow(2);
        // OpenCV divides by the next power of two and puts the rest into the table.
        let shift = area.next_power_of_two().trailing_zeros();
        let unit = (1u32 << shift) as f64 / area as f64;
        let whole = f64::from(i32::MAX as u32 / ((2 * search + 1).pow(2) * 255) as u32);
        let weight = |index: u32| {
            let weight = (whole * (-f64::from(index) * unit / (h * h * N as f64)).exp()).round_ties_even();
            if weight < 0.001 * whole { 0 } else { weight as u32 }
        };
        let weights = (0..).map(weight).take_while(|weight| *weight > 0).chain([0]).collect();
        Self { planes, width, height, wide, border, template, search, shift, weights }
    }

    /// The rows from `top` on.
    fn strip(&self, top: usize) -> [Vec<u8>; N] {
        let rows = STRIP.min(self.height - top);
        let mut total = vec![0u32; rows * self.width];
        let mut sums = [(); N].map(|()| vec![0u32; rows * self.width]);
        let mut squares = vec![0u32; (rows + 2 * self.template) * (self.width + 2 * self.template)];
        let mut columns = vec![0u32; self.width + 2 * self.template];
        let reach = self.search as isize;
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                self.differences(top, rows, (dx, dy), &mut squares);
                self.gather(top, rows, (dx, dy), &squares, &mut columns, &mut total, &mut sums);
            }
        }
        sums.map(|sums| {
            // The weight at no shift is the largest there is, so that no total is 0.
            sums.iter().zip(&total).map(|(sum, total)| ((sum + total / 2) / total) as u8).collect()
        })
    }

    /// Squared differences between the rows, with the template's rows around them, and the rows shifted.
    fn differences(&self, top: usize, rows: usize, (dx, dy): (isize, isize), squares: &mut [u32]) {
        let length = self.width + 2 * self.template;
        let start = self.border - self.template;
        for (row, into) in squares.chunks_exact_mut(length).take(rows + 2 * self.template).enumerate() {
            let y = top + row + start;
            let here = y * self.wide + start;
            let there = (y as isize + dy) as usize * self.wide + (start as isize + dx) as usize;
            for (plane, values) in self.planes.iter().enumerate() {
                let pairs = values[here..][..length].iter().zip(&values[there..][..length]);
                for (square, (a, b)) in into.iter_mut().zip(pairs) {
                    let apart = u32::from(a.abs_diff(*b));
                    *square = apart * apart + if plane == 0 { 0 } else { *square };
                }
            }
        }
    }

    /// Adds the shifted pixels, weighted by the squares' sums over the template.
    #[expect(clippy::too_many_arguments, reason = "the strip's own memory, which is used again for every shift")]
    fn gather(
        &self,
        top: usize,
        rows: usize,
        (dx, dy): (isize, isize),
        squares: &[u32],
        columns: &mut [u32],
        total: &mut [u32],
        sums: &mut [Vec<u32>; N],
    ) {
        let (length, side) = (self.width + 2 * self.template, 2 * self.template + 1);
        let last = self.weights.len() - 1;
        columns.fill(0);
        for line in squares.chunks_exact(length).take(side - 1) {
            columns.iter_mut().zip(line).for_each(|(sum, square)| *sum += square);
        }
        let mut weights = vec![0u32; self.width];
        for row in 0..rows {
            let entering = &squares[(row + side - 1) * length..][..length];
            columns.iter_mut().zip(entering).for_each(|(sum, square)| *sum += square);
            weights.copy_from_slice(&columns[..self.width]);
            for along in 1..side {
                weights.iter_mut().zip(&columns[along..]).for_each(|(sum, column)| *sum += column);
            }
            weights.iter_mut().for_each(|sum| *sum = self.weights[((*sum >> self.shift) as usize).min(last)]);
            let there = (top + row + self.border) as isize + dy;
            let there = there as usize * self.wide + (self.border as isize + dx) as usize;
            let own = row * self.width..(row + 1) * self.width;
            total[own.clone()].iter_mut().zip(&weights).for_each(|(sum, weight)| *sum += weight);
            for (sums, plane) in sums.iter_mut().zip(&self.planes) {
                let pixels = weights.iter().zip(&plane[there..][..self.width]);
                for (sum, (weight, pixel)) in sums[own.clone()].iter_mut().zip(pixels) {
                    *sum += weight * u32::from(*pixel);
                }
            }
            let leaving = &squares[row * length..][..length];
            columns.iter_mut().zip(leaving).for_each(|(sum, square)| *sum -= square);
        }
    }
}

/// CIE XYZ (D65) of linear RGB, by rows.
const XYZ: [[f64; 3]; 3] =
    [[0.412_453, 0.357_580, 0.180_423], [0.212_671, 0.715_160, 0.072_169], [0.019_334, 0.119_193, 0.950_227]];
/// White, D65.
const D65: [f64; 3] = [0.950_456, 1.0, 1.088_754];
/// Where the cube root gives way to a line, and that line.
const KNEE: f64 = 216.0 / 24389.0;
const SLOPE: f64 = 841.0 / 108.0;
const OFFSET: f64 = 16.0 / 116.0;

/// L, a and b in bytes of linear RGB, in OpenCV's whole numbers: 12 bits for the matrix, 15 for the cube root, and a
/// light that is told to an eighth of a byte.
fn to_lab(rgb: &[u8]) -> [Vec<u8>; 3] {
    let one = f64::from(1 << 15);
    let root = |i: i32| {
        let x = f64::from(i) / (255.0 * 8.0);
        let f = if x < KNEE { x * SLOPE + OFFSET } else { x.cbrt() };
        (one * f).round_ties_even() as i32
    };
    let roots: Vec<i32> = (0..256 * 3 / 2 * 8).map(root).collect();
    let matrix: Vec<[i32; 3]> =
        XYZ.iter().zip(D65).map(|(row, white)| row.map(|c| (4096.0 * c / white).round_ties_even() as i32)).collect();
    let rounded = |value: i32, bits: u32| (value + (1 << (bits - 1))) >> bits;
    let mut lab = [(); 3].map(|()| Vec::with_capacity(rgb.len() / 3));
    for pixel in rgb.chunks_exact(3) {
        let [fx, fy, fz] = [0, 1, 2].map(|axis: usize| {
            let row: &[i32; 3] = &matrix[axis];
            let light: i32 = row.iter().zip(pixel).map(|(c, byte)| c * i32::from(*byte) * 8).sum();
            roots[rounded(light, 12) as usize]
        });
        let middle = 128 << 15;
        let lightness = rounded(((116 * 255 + 50) / 100) * fy - ((16 * 255 * (1 << 15) + 50) / 100), 15);
        let values = [lightness, rounded(500 * (fx - fy) + middle, 15), rounded(200 * (fy - fz) + middle, 15)];
        for (plane, value) in lab.iter_mut().zip(values) {
            plane.push(value.clamp(0, 255) as u8);
        }
    }
    lab
}

/// Linear RGB of L, a and b in bytes.
fn from_lab(lightness: &[u8], a: &[u8], b: &[u8]) -> Vec<u8> {
    let matrix = nalgebra::Matrix3::from_fn(|row, column| XYZ[row][column]).try_inverse().unwrap_or_default();
    let mut rgb = Vec::with_capacity(3 * lightness.len());
    for ((&lightness, &a), &b) in lightness.iter().zip(a).zip(b) {
        let l = f64::from(lightness) * 100.0 / 255.0;
        let (y, fy) = if l <= 8.0 {
            (l / 903.3, SLOPE * l / 903.3 + OFFSET)
        } else {
            let fy = (l + 16.0) / 116.0;
            (fy * fy * fy, fy)
        };
        let cubed = |f: f64| if f <= 6.0 / 29.0 { (f - OFFSET) / SLOPE } else { f * f * f };
        let x = cubed(fy + (f64::from(a) - 128.0) / 500.0) * D65[0];
        let z = cubed(fy - (f64::from(b) - 128.0) / 200.0) * D65[2];
        let light = matrix * nalgebra::Vector3::new(x, y, z);
        // OpenCV cuts off here where it rounds elsewhere.
        rgb.extend(light.iter().map(|value| (value * 255.0).clamp(0.0, 255.0) as u8));
    }
    rgb
}
