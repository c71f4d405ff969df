//! The same development written plainly, one output pixel at a time in double precision, and frames to try it on.

use nightflow::{
    camera::Frame,
    clock::Stamp,
    exposure::{Config, Justification, Packing, Pattern},
    wire::{Header, Image, Time},
};
use proptest::prelude::*;

/// How the counts are laid into bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bytes {
    One,
    Little,
    Big,
    Raw10,
    Raw12,
}

/// A frame together with the counts that it was made of.
#[derive(Debug, Clone)]
pub struct Scene {
    pub frame: Frame,
    pub config: Config,
    pub width: usize,
    pub height: usize,
    pub counts: Vec<u16>,
    pub pattern: Option<Pattern>,
    pub black: f64,
    pub white: f64,
}

pub struct Developed {
    pub size: [usize; 2],
    pub scale: [f32; 2],
    pub reduced: Vec<f64>,
    pub saturated: Vec<u8>,
    pub raw_mean: f64,
    /// The mean of all pixels, of which a mosaic has twice as many green ones.
    pub light: f64,
}

/// The overlap of [a, a + 1) with the output pixel `i` of size `scale`.
fn overlap(a: usize, i: usize, scale: f64) -> f64 {
    let (from, to) = (i as f64 * scale, (i + 1) as f64 * scale);
    ((a as f64 + 1.0).min(to) - (a as f64).max(from)).max(0.0)
}

pub fn reference(scene: &Scene) -> Developed {
    let cell = if scene.pattern.is_some() { 2 } else { 1 };
    let cells = [scene.width / cell, scene.height / cell];
    let width = cells[0].min(scene.config.width_max);
    let height = ((cells[1] as f64 * width as f64 / cells[0] as f64).round() as usize).clamp(1, cells[1]);
    let scale = [cells[0] as f64 / width as f64, cells[1] as f64 / height as f64];
    let at = |x: usize, y: usize| f64::from(scene.counts[y * scene.width + x]);
    let colours = |x: usize, y: usize| -> [f64; 3] {
        let quad = |dx: usize, dy: usize| at(2 * x + dx, 2 * y + dy);
        match scene.pattern {
            None => [at(x, y); 3],
            Some(Pattern::Rggb) => [quad(0, 0), (quad(1, 0) + quad(0, 1)) / 2.0, quad(1, 1)],
            Some(Pattern::Bggr) => [quad(1, 1), (quad(1, 0) + quad(0, 1)) / 2.0, quad(0, 0)],
            Some(Pattern::Gbrg) => [quad(0, 1), (quad(0, 0) + quad(1, 1)) / 2.0, quad(1, 0)],
            Some(Pattern::Grbg) => [quad(1, 0), (quad(0, 0) + quad(1, 1)) / 2.0, quad(0, 1)],
        }
    };
    let mut reduced = vec![0.0; 3 * width * height];
    let mut saturated = vec![0; width * height];
    for y in 0..height {
        for x in 0..width {
            for cell_y in 0..cells[1] {
                for cell_x in 0..cells[0] {
                    let area = overlap(cell_x, x, scale[0]) * overlap(cell_y, y, scale[1]);
                    if area < 1e-9 {
                        continue;
                    }
                    for (plane, value) in colours(cell_x, cell_y).iter().enumerate() {
                        let value = (value - scene.black) / (scene.white - scene.black);
                        reduced[plane * width * height + y * width + x] += value * area / (scale[0] * scale[1]);
                    }
                    for (dx, dy) in (0..cell).flat_map(|dy| (0..cell).map(move |dx| (dx, dy))) {
                        if at(cell_x * cell + dx, cell_y * cell + dy) >= scene.white {
                            saturated[y * width + x] = 1;
                        }
                    }
                }
            }
        }
    }
    let raw_mean = reduced.iter().sum::<f64>() / reduced.len() as f64;
    let light =
        raw_mean * 0.75 + reduced[width * height..2 * width * height].iter().sum::<f64>() / (4 * width * height) as f64;
    Developed {
        size: [width, height],
        scale: std::array::from_fn(|i| (scale[i] * cell as f64) as f32),
        reduced,
        saturated,
        raw_mean,
        light,
    }
}

/// Lays counts into the bytes of a message, rows padded with bytes that must not be read.
pub fn lay(counts: &[u16], width: usize, bytes: Bytes, shift: u32, padding: usize) -> (usize, Vec<u8>) {
    let mut out = Vec::new();
    let mut step = 0;
    for row in counts.chunks(width) {
        let start = out.len();
        match bytes {
            Bytes::One => out.extend(row.iter().map(|count| *count as u8)),
            Bytes::Little => out.extend(row.iter().flat_map(|count| (count << shift).to_le_bytes())),
            Bytes::Big => out.extend(row.iter().flat_map(|count| (count << shift).to_be_bytes())),
            Bytes::Raw10 => {
                for group in row.chunks(4) {
                    let count = |i: usize| group.get(i).copied().unwrap_or(0);
                    out.extend((0..4).map(|i| (count(i) >> 2) as u8));
                    out.push((0..4).map(|i| ((count(i) & 3) as u8) << (2 * i)).sum());
                }
            }
            Bytes::Raw12 => {
                for group in row.chunks(2) {
                    let count = |i: usize| group.get(i).copied().unwrap_or(0);
                    out.extend([(count(0) >> 4) as u8, (count(1) >> 4) as u8]);
                    out.push((count(0) & 15) as u8 | ((count(1) & 15) as u8) << 4);
                }
            }
        }
        out.extend(std::iter::repeat_n(0xa5, padding));
        step = out.len() - start;
    }
    (step, out)
}

fn patterns() -> impl Strategy<Value = Option<Pattern>> {
    prop_oneof![
        Just(None),
        Just(Some(Pattern::Rggb)),
        Just(Some(Pattern::Bggr)),
        Just(Some(Pattern::Gbrg)),
        Just(Some(Pattern::Grbg)),
    ]
}

/// Encoding name, layout, depth, justification, pattern.
fn formats() -> impl Strategy<Value = (String, Bytes, u8, Justification, Option<Pattern>)> {
    let bytes =
        prop_oneof![Just(Bytes::One), Just(Bytes::Little), Just(Bytes::Big), Just(Bytes::Raw10), Just(Bytes::Raw12)];
    let depth = prop_oneof![Just(8u8), Just(10), Just(12), Just(14), Just(16)];
    (bytes, depth, any::<bool>(), patterns(), any::<bool>()).prop_map(|(bytes, depth, high, pattern, numeric)| {
        let wide = matches!(bytes, Bytes::Little | Bytes::Big);
        let (depth, justification) = match bytes {
            Bytes::One => (8, Justification::Low),
            Bytes::Raw10 => (10, Justification::Low),
            Bytes::Raw12 => (12, Justification::Low),
            _ => (depth, if high { Justification::High } else { Justification::Low }),
        };
        let encoding = match (bytes, wide, pattern) {
            (Bytes::Raw10 | Bytes::Raw12, ..) => "8UC1".to_string(),
            _ if numeric => if wide { "16UC1" } else { "8UC1" }.to_string(),
            (_, true, None) => "mono16".to_string(),
            (_, false, None) => "mono8".to_string(),
            (_, wide, Some(pattern)) => format!("bayer_{pattern}{}", if wide { 16 } else { 8 }),
        };
        (encoding, bytes, depth, justification, pattern)
    })
}

/// Frames of every format and many sizes.
pub fn scenes() -> impl Strategy<Value = Scene> {
    let sizes = (2usize..200, 2usize..40, 1usize..48, 0usize..20);
    (formats(), sizes, any::<u32>(), 0u8..3).prop_map(|(format, (width, height, width_max, padding), seed, bright)| {
        let (encoding, bytes, depth, justification, pattern) = format;
        let white = (1u32 << depth) - 1;
        let black = white / 16;
        // From dark noise around black to an image that saturates in part.
        let (from, range) = match bright {
            0 => (black - 8, 24),
            1 => (black, white / 4),
            _ => (white - white / 4, white / 4 + 1),
        };
        let counts: Vec<u16> = (0..(width * height) as u32)
            .map(|i| (from + super::scramble(i, 0, seed) % range).min(white) as u16)
            .collect();
        let shift = if justification == Justification::High { 16 - u32::from(depth) } else { 0 };
        let (step, laid) = lay(&counts, width, bytes, shift, padding);
        let packing = match bytes {
            Bytes::Raw10 => Some(Packing::Raw10),
            Bytes::Raw12 => Some(Packing::Raw12),
            _ => None,
        };
        let config = Config {
            width_max,
            bit_depth: Some(depth),
            justification,
            black_level: Some(black as f32),
            pattern: pattern.filter(|_| encoding.ends_with("UC1")),
            packing,
            ..Config::default()
        };
        let image = Image {
            header: Header { stamp: Time { sec: 1, nanosec: 0 }, frame_id: "camera".into() },
            height: height as u32,
            width: width as u32,
            encoding,
            // The flag means nothing for single bytes, and some drivers set it all the same.
            is_bigendian: u8::from(bytes != Bytes::Little && seed % 2 == 0 || bytes == Bytes::Big),
            step: step as u32,
            data: laid,
        };
        let frame = Frame { image, received: Stamp::default() };
        Scene { frame, config, width, height, counts, pattern, black: black.into(), white: white.into() }
    })
}
