//! What a recipe does to every pixel, by strips that stay in the processor's first cache.

use multiversion::multiversion;

use super::super::{
    curves,
    gaussians::{BLOCK, Gaussians},
};

/// Bytes of a strip: a whole number of pixels, of vectors of any width, and of blocks of draws.
pub(super) const STRIP: usize = 12 * BLOCK;
const PIXELS: usize = STRIP / 3;
/// Pixels of a frame that its noise level is predicted from.
const SAMPLE: usize = 4096;
/// The estimator of the noise level reads so much of the deviation that is there: the median over 585 pairs of 512×384
/// made of 195 photographs, levels of 4 and more. The scatter that it takes for even leans to the right.
const ESTIMATED: f64 = 0.955;
/// Clean values of a colour are counted in so many equal steps.
const BINS: usize = 48;

/// From a frame's byte to the mean of what the camera would see, on the 8-bit scale.
pub(super) struct Clean {
    /// A table for each colour.
    pub curves: [[f32; 256]; 3],
    /// Then, where there is one, a camera.
    pub camera: Option<Camera>,
}

/// What a camera sees of linear colours.
pub(super) struct Camera {
    /// From red, green and blue; a row for each of the camera's colours.
    pub matrix: [[f32; 3]; 3],
    /// Gains after that, which spare the highlights.
    pub gains: [f32; 3],
}

/// From mean and draw to the byte that is written.
pub(super) enum Grain {
    /// Deviation √(a·x + b), rounded.
    Root,
    /// Deviation a·x + b, cut to a whole number, times a gain for each colour, cut again.
    Line { gains: [f32; 3] },
}

/// A recipe with its figures, all on the 8-bit scale: a in 255ths, b in 255ths squared ([`Grain::Root`]) or in 255ths.
pub(super) struct Plan {
    pub clean: Clean,
    pub grain: Grain,
    pub a: [f32; 3],
    pub b: [f32; 3],
}

impl Plan {
    /// Turns a frame into a dark one.
    pub fn develop(&self, series: &mut Gaussians, frame: &mut [u8]) {
        let (a, b) = (woven(self.a), woven(self.b));
        let gains = match self.grain {
            Grain::Root => [1.0; STRIP],
            Grain::Line { gains } => woven(gains),
        };
        let (mut means, mut draws) = ([0.0; STRIP], [0.0; STRIP]);
        let mut strip = |bytes: &mut [u8; STRIP]| {
            self.clean.means(bytes, &mut means);
            series.fill(&mut draws);
            match self.grain {
                Grain::Root => rounded(bytes, &means, &draws, &a, &b),
                Grain::Line { .. } => cut(bytes, &means, &draws, [&a, &b, &gains]),
            }
        };
        let (strips, rest) = frame.as_chunks_mut::<STRIP>();
        strips.iter_mut().for_each(&mut strip);
        if !rest.is_empty() {
            let mut last = [0; STRIP];
            last[..rest.len()].copy_from_slice(rest);
            strip(&mut last);
            rest.copy_from_slice(&last[..rest.len()]);
        }
    }
}

/// A figure of each colour, as the bytes of a strip are.
fn woven(colours: [f32; 3]) -> [f32; STRIP] {
    std::array::from_fn(|at| colours[at % 3])
}

impl Clean {
    /// What the camera would see of a strip of bytes.
    pub fn means(&self, bytes: &[u8; STRIP], means: &mut [f32; STRIP]) {
        looked_up(bytes, &self.curves, means);
        let Some(camera) = &self.camera else { return };
        let mut planes = [[0.0; PIXELS]; 3];
        for (at, mean) in means.as_chunks::<3>().0.iter().enumerate() {
            for (plane, value) in planes.iter_mut().zip(mean) {
                plane[at] = *value;
            }
        }
        seen(camera, &mut planes);
        for (at, mean) in means.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            *mean = [planes[0][at], planes[1][at], planes[2][at]];
        }
    }
}

/// Kept out of the vectorised part: vector gathers are slower than loads one by one.
fn looked_up(bytes: &[u8; STRIP], [red, green, blue]: &[[f32; 256]; 3], means: &mut [f32; STRIP]) {
    for (bytes, means) in bytes.as_chunks::<3>().0.iter().zip(means.as_chunks_mut::<3>().0) {
        *means = [red[usize::from(bytes[0])], green[usize::from(bytes[1])], blue[usize::from(bytes[2])]];
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn seen(camera: &Camera, planes: &mut [[f32; PIXELS]; 3]) {
    // Gains give way to 1 as the mean of the colours goes from here to white.
    const INFLECTION: f32 = 0.9 * 255.0;
    let [reds, greens, blues] = planes;
    for ((red, green), blue) in reds.iter_mut().zip(greens.iter_mut()).zip(blues.iter_mut()) {
        let mut colours = [0.0; 3];
        for (colour, row) in colours.iter_mut().zip(&camera.matrix) {
            *colour = *red * row[0] + *green * row[1] + *blue * row[2];
        }
        let grey = (colours[0] + colours[1] + colours[2]) * (1.0 / 3.0);
        let light = (grey - INFLECTION).max(0.0) * (1.0 / (255.0 - INFLECTION));
        let mask = light * light;
        for (colour, gain) in colours.iter_mut().zip(&camera.gains) {
            let safe = (mask + (1.0 - mask) * gain).max(*gain);
            *colour = (*colour * safe).clamp(0.0, 255.0);
        }
        [*red, *green, *blue] = colours;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn rounded(bytes: &mut [u8; STRIP], means: &[f32; STRIP], draws: &[f32; STRIP], a: &[f32; STRIP], b: &[f32; STRIP]) {
    for at in 0..STRIP {
        let sigma = (a[at] * means[at] + b[at]).sqrt();
        bytes[at] = nearest((means[at] + sigma * draws[at]).clamp(0.0, 255.0));
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn cut(bytes: &mut [u8; STRIP], means: &[f32; STRIP], draws: &[f32; STRIP], [a, b, gains]: [&[f32; STRIP]; 3]) {
    for at in 0..STRIP {
        let sigma = a[at] * means[at] + b[at];
        let value = (means[at] + sigma * draws[at]).clamp(0.0, 255.0).trunc();
        bytes[at] = nearest((value * gains[at]).clamp(0.0, 255.0).trunc());
    }
}

/// The nearest whole number of a value in 0…255. At 2²³ a float counts in ones, and its last byte is the number: this
/// takes one addition, where a cast would also have to mind what does not fit.
#[inline(always)]
fn nearest(value: f32) -> u8 {
    (value + (1_u32 << 23) as f32).to_bits() as u8
}

/// How the clean values of a frame lie, colour by colour.
pub(super) struct Spread {
    /// Mean clean value of a step in 0…1, and the part of the colour's pixels in it.
    steps: [[(f64, f64); BINS]; 3],
}

impl Spread {
    /// Looks at some pixels of a frame, spread over it without a pattern.
    pub fn of(clean: &Clean, frame: &[u8]) -> Self {
        let pixels = frame.as_chunks::<3>().0;
        let taken = pixels.len().min(SAMPLE);
        let (mut bytes, mut means) = ([0; STRIP], [0.0; STRIP]);
        let mut sums = [[(0.0_f64, 0_u32); BINS]; 3];
        for begin in (0..taken).step_by(PIXELS) {
            let count = (taken - begin).min(PIXELS);
            for (at, pixel) in bytes.as_chunks_mut::<3>().0[..count].iter_mut().enumerate() {
                *pixel = pixels[scattered(begin + at, taken, pixels.len())];
            }
            clean.means(&bytes, &mut means);
            for mean in &means.as_chunks::<3>().0[..count] {
                for (colour, value) in mean.iter().enumerate() {
                    let value = f64::from(*value) / 255.0;
                    let (sum, number) = &mut sums[colour][((value * BINS as f64) as usize).min(BINS - 1)];
                    *sum += value;
                    *number += 1;
                }
            }
        }
        let part = |(sum, number): (f64, u32)| (sum / f64::from(number.max(1)), f64::from(number) / taken as f64);
        Self { steps: sums.map(|colour| colour.map(part)) }
    }

    /// Mean clean value of a colour, 0…1.
    pub fn mean(&self, colour: usize) -> f64 {
        self.steps[colour].iter().map(|(value, part)| value * part).sum()
    }

    /// The noise level, 0…1, that noise shows which has `variance` (of a colour and a clean value) until it is clipped to
    /// 0…1, as Chen et al. 2015 would estimate it over the three colours.
    ///
    /// Each colour adds its share of eigenvalues about its own mean variance. The estimator takes the largest away until
    /// mean and median meet: that is at the middle colour's variance, or at the mean of all if that is less.
    pub fn level(&self, variance: impl Fn(usize, f64) -> f64) -> f64 {
        let mut colours = [0.0; 3];
        for (colour, (sum, steps)) in colours.iter_mut().zip(&self.steps).enumerate() {
            for (value, part) in steps.iter().filter(|(_, part)| *part > 0.0) {
                *sum += part * curves::clipped_variance(*value, variance(colour, *value));
            }
        }
        colours.sort_by(f64::total_cmp);
        (colours.iter().sum::<f64>() / 3.0).min(colours[1]).sqrt() * ESTIMATED
    }
}

/// The `number`th of `taken` places among `pixels`: one in each of as many equal stretches, anywhere in it.
fn scattered(number: usize, taken: usize, pixels: usize) -> usize {
    let (begin, end) = (number * pixels / taken, (number + 1) * pixels / taken);
    begin + (number.wrapping_mul(0x9e37_79b1) >> 7) % (end - begin)
}
