//! Textures: a picture with its halved copies, sampled trilinearly, so that nothing aliases when it gets smaller.

use image::{RgbaImage, imageops};

/// Pictures are brought to this many pixels on their short side.
pub(super) const SIDE: u32 = 512;
/// A copy is no smaller than this.
const LEAST: usize = 4;
/// Texture pixels; nothing is looked up beyond.
const FARTHEST: f32 = 1e6;

/// A picture and its halved copies.
#[derive(Debug, Clone)]
pub(super) struct Texture {
    levels: Vec<Level>,
    /// Transparent outside (a cut-out); otherwise mirrored without end.
    bounded: bool,
}

/// Colours are multiplied by their opacity, which the last channel holds.
#[derive(Debug, Clone)]
struct Level {
    width: usize,
    height: usize,
    pixels: Vec<[u8; 4]>,
}

impl Texture {
    /// A picture without transparency, mirrored at its borders without end.
    pub fn endless(width: usize, height: usize, pixels: Vec<[u8; 4]>) -> Texture {
        Texture::new(Level { width, height, pixels }, false)
    }

    /// A photograph, brought to the usual size.
    pub fn photograph(image: RgbaImage) -> Texture {
        let image = sized(image, SIDE);
        let (width, height) = image.dimensions();
        let pixels = image.pixels().map(|pixel| [pixel.0[0], pixel.0[1], pixel.0[2], 255]).collect();
        Texture::endless(width as usize, height as usize, pixels)
    }

    /// A picture whose transparency is its outline; `None` if it has none, or shows next to nothing.
    pub fn cutout(image: RgbaImage) -> Option<Texture> {
        let image = sized(image, SIDE / 2);
        let (width, height) = (image.width() as usize, image.height() as usize);
        let opaque = image.pixels().filter(|pixel| pixel.0[3] > 127).count();
        let part = opaque as f64 / (width * height).max(1) as f64;
        if width < 8 || height < 8 || !(0.03..0.97).contains(&part) {
            return None;
        }
        let pixel = |[r, g, b, a]: [u8; 4]| {
            let times = |colour: u8| ((u16::from(colour) * u16::from(a) + 127) / 255) as u8;
            [times(r), times(g), times(b), a]
        };
        let pixels = image.pixels().map(|found| pixel(found.0)).collect();
        Some(Texture::new(Level { width, height, pixels }, true))
    }

    fn new(first: Level, bounded: bool) -> Texture {
        let mut levels = vec![first];
        while let Some(half) = levels.last().and_then(Level::half) {
            levels.push(half);
        }
        Texture { levels, bounded }
    }

    /// Columns and rows.
    pub fn size(&self) -> [usize; 2] {
        [self.levels[0].width, self.levels[0].height]
    }

    /// A square out of it that repeats (mirrored) without end.
    pub fn tile(&self, corner: [usize; 2], side: usize) -> Texture {
        let Level { width, height, pixels } = &self.levels[0];
        let at = |i: usize| {
            let (column, row) = ((corner[0] + i % side).min(width - 1), (corner[1] + i / side).min(height - 1));
            pixels[row * width + column]
        };
        Texture::endless(side, side, (0..side * side).map(at).collect())
    }

    /// Premultiplied colour and opacity (0…255) at (`x`, `y`) in its own pixels, whose centres are whole numbers, for a
    /// sample that is 2^`lod` of them wide.
    #[inline(always)]
    pub fn sample(&self, x: f32, y: f32, lod: f32) -> [f32; 4] {
        let most = (self.levels.len() - 1) as f32;
        let lod = lod.clamp(0.0, most);
        let low = lod as usize;
        let part = lod - low as f32;
        // What lies towards the horizon is far beyond any picture, and its place has to fit a whole number.
        let (x, y) = (x.clamp(-FARTHEST, FARTHEST), y.clamp(-FARTHEST, FARTHEST));
        let fine = self.level(low, x, y);
        if part < 0.02 || low + 1 >= self.levels.len() {
            return fine;
        }
        let coarse = self.level(low + 1, x, y);
        std::array::from_fn(|c| fine[c] + part * (coarse[c] - fine[c]))
    }

    #[inline(always)]
    fn level(&self, number: usize, x: f32, y: f32) -> [f32; 4] {
        let level = &self.levels[number];
        let scale = 1.0 / (1_u32 << number) as f32;
        let (x, y) = ((x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5);
        let (column, row) = (floor(x), floor(y));
        let (fx, fy) = (x - column as f32, y - row as f32);
        let (w, h) = (level.width as i32, level.height as i32);
        let [a, b, c, d] = if column >= 0 && row >= 0 && column + 1 < w && row + 1 < h {
            let at = row as usize * level.width + column as usize;
            [level.pixels[at], level.pixels[at + 1], level.pixels[at + level.width], level.pixels[at + level.width + 1]]
        } else if self.bounded {
            [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| level.inside(column + dx, row + dy))
        } else {
            [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| level.mirrored(column + dx, row + dy))
        };
        std::array::from_fn(|i| {
            let upper = f32::from(a[i]) + fx * (f32::from(b[i]) - f32::from(a[i]));
            let lower = f32::from(c[i]) + fx * (f32::from(d[i]) - f32::from(c[i]));
            upper + fy * (lower - upper)
        })
    }

    /// How much neighbouring places differ within a window (0…255): skies teach little.
    pub fn liveliness(&self, middle: [f64; 2], reach: f64) -> f32 {
        const STEPS: i32 = 8;
        let lod = ((reach / f64::from(STEPS) * 0.5).log2()).max(0.0) as f32;
        let at = |i: i32, j: i32| {
            let place = |centre: f64, k: i32| (centre + (f64::from(k) / f64::from(STEPS) - 0.5) * 2.0 * reach) as f32;
            self.sample(place(middle[0], i), place(middle[1], j), lod)
        };
        let mut sum = 0.0;
        for (i, j) in (0..STEPS).flat_map(|i| (0..STEPS).map(move |j| (i, j))) {
            let (here, right, down) = (at(i, j), at(i + 1, j), at(i, j + 1));
            sum += (0..3).map(|c| (here[c] - right[c]).abs() + (here[c] - down[c]).abs()).sum::<f32>();
        }
        sum / (6 * STEPS * STEPS) as f32
    }
}

impl Level {
    fn half(&self) -> Option<Level> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width < LEAST || height < LEAST {
            return None;
        }
        let mean = |column: usize, row: usize| -> [u8; 4] {
            let at = 2 * row * self.width + 2 * column;
            let four = [at, at + 1, at + self.width, at + self.width + 1].map(|at| self.pixels[at]);
            std::array::from_fn(|c| ((four.iter().map(|pixel| u16::from(pixel[c])).sum::<u16>() + 2) / 4) as u8)
        };
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        Some(Level { width, height, pixels: pixels.map(|(column, row)| mean(column, row)).collect() })
    }

    #[cold]
    fn inside(&self, column: i32, row: i32) -> [u8; 4] {
        let within = column >= 0 && row >= 0 && column < self.width as i32 && row < self.height as i32;
        if within { self.pixels[row as usize * self.width + column as usize] } else { [0; 4] }
    }

    fn mirrored(&self, column: i32, row: i32) -> [u8; 4] {
        let fold = |at: i32, count: usize| {
            let at = at.rem_euclid(2 * count as i32) as usize;
            if at < count { at } else { 2 * count - 1 - at }
        };
        self.pixels[fold(row, self.height) * self.width + fold(column, self.width)]
    }
}

/// The next whole number below; without SSE 4.1 the library's own is a call.
#[inline(always)]
fn floor(value: f32) -> i32 {
    let whole = value as i32;
    whole - i32::from(value < whole as f32)
}

fn sized(image: RgbaImage, side: u32) -> RgbaImage {
    let (width, height) = image.dimensions();
    let short = width.min(height);
    if short <= side {
        return image;
    }
    let scaled = |length: u32| (u64::from(length) * u64::from(side)).div_ceil(u64::from(short)) as u32;
    imageops::resize(&image, scaled(width), scaled(height), imageops::FilterType::Triangle)
}
