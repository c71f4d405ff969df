//! What scenes are papered with: photographs, cut-outs, and textures made by formula where there is neither.

use std::{
    borrow::Cow,
    f64::consts::TAU,
    path::{Path, PathBuf},
};

use rayon::prelude::*;

use super::{
    Error, Part,
    maps::{Dice, Map, shift, turn},
    render::Fill,
    texture::{SIDE, Texture},
};
use crate::darkness::flow_files;

/// Mean step between neighbouring places below which a window is called dull, 0…255.
const DULL: f32 = 7.0;
/// How often a dull window is drawn again.
const TRIES: usize = 4;
/// How many textures are made where there are no photographs.
const MADE: u64 = 20;
/// Their side, pixels.
const MADE_SIDE: usize = 320;

/// Textures, kept decoded: about 2 MB a photograph.
pub struct Library {
    pub(super) pictures: Vec<Texture>,
    pub(super) cutouts: Vec<Texture>,
    /// Files that could not be used, and why.
    pub left_out: Vec<String>,
}

impl Library {
    /// Reads the photographs (PNG, JPEG, PNM) of a folder, and the cut-outs (PNG with transparency) of another with its
    /// folders; both in the order of their names. Files that are no pictures are left out and named.
    pub fn read(photos: &Path, cutouts: Option<&Path>, part: Part) -> Result<Library, Error> {
        let mut library = Library { pictures: Vec::new(), cutouts: Vec::new(), left_out: Vec::new() };
        let files = part.of(listed(photos)?);
        let read: Vec<_> = files.par_iter().map(|path| flow_files::read_cutout(path)).collect();
        for found in read {
            match found {
                Ok(image) => library.pictures.push(Texture::photograph(image)),
                Err(error) => library.left_out.push(error.to_string()),
            }
        }
        if library.pictures.is_empty() {
            return Err(Error::NoPictures { folder: photos.into(), files: files.len() });
        }
        if let Some(folder) = cutouts {
            let files = listed(folder)?;
            let read = files.par_iter().map(|path| flow_files::read_cutout(path).map(Texture::cutout));
            for found in read.collect::<Vec<_>>() {
                match found {
                    Ok(cutout) => library.cutouts.extend(cutout),
                    Err(error) => library.left_out.push(error.to_string()),
                }
            }
            if library.cutouts.is_empty() {
                return Err(Error::NoPictures { folder: folder.into(), files: files.len() });
            }
        }
        Ok(library)
    }

    /// Textures by formula: noise of many scales, cells, bricks and stripes. They need no files, and look it.
    pub fn by_formula(seed: u64) -> Library {
        let pictures = (0..MADE).into_par_iter().map(|index| made(&mut Dice::new(seed ^ 0x7e87, index))).collect();
        Library { pictures, cutouts: Vec::new(), left_out: Vec::new() }
    }

    /// How many pictures and cut-outs there are.
    pub fn counts(&self) -> [usize; 2] {
        [self.pictures.len(), self.cutouts.len()]
    }

    /// A window of some picture for a layer that reaches so far; `zoom` is texture pixels a layer pixel.
    pub(super) fn window(&self, dice: &mut Dice, reach: f64, zoom: [f64; 2], turned: f64) -> Fill<'_> {
        let mut best: Option<(f32, Fill<'_>)> = None;
        for _ in 0..TRIES {
            let texture = &self.pictures[dice.pick(self.pictures.len())];
            let zoom = dice.ratio(zoom[0], zoom[1]);
            let half = reach * zoom;
            let middle = texture.size().map(|side| {
                let side = side as f64;
                if 2.0 * half < side { dice.even(half, side - half) } else { dice.even(0.25, 0.75) * side }
            });
            let mirror = if dice.chance(0.5) { -1.0 } else { 1.0 };
            let place =
                shift(middle) * turn(turned * dice.normal(), zoom) * Map::from_diagonal(&[mirror, 1.0, 1.0].into());
            let lively = texture.liveliness(middle, half.min(f64::from(SIDE) / 2.0));
            let fill = Fill { texture: Cow::Borrowed(texture), place: rows(&place), tint: tint(dice) };
            if lively > DULL || dice.chance(0.1) {
                return fill;
            }
            if best.as_ref().is_none_or(|(most, _)| lively > *most) {
                best = Some((lively, fill));
            }
        }
        match best {
            Some((_, fill)) => fill,
            None => Fill { texture: Cow::Borrowed(&self.pictures[0]), place: rows(&Map::identity()), tint: [1.0; 3] },
        }
    }

    /// A small square of some picture, again and again.
    pub(super) fn repeated(&self, dice: &mut Dice) -> Fill<'_> {
        let texture = &self.pictures[dice.pick(self.pictures.len())];
        let side = 12 + dice.pick(36);
        let corner = texture.size().map(|length| dice.pick(length.saturating_sub(side).max(1)));
        let place = turn(dice.even(0.0, TAU), dice.ratio(0.8, 2.0));
        Fill { texture: Cow::Owned(texture.tile(corner, side)), place: rows(&place), tint: tint(dice) }
    }

    /// A cut-out whose longer side reaches so far to either side of the middle.
    pub(super) fn cutout(&self, dice: &mut Dice, reach: f64) -> Option<Fill<'_>> {
        let texture = self.cutouts.get(dice.pick(self.cutouts.len()))?;
        let [width, height] = texture.size().map(|side| side as f64);
        let zoom = width.max(height) / (2.0 * reach);
        let middle = [(width - 1.0) / 2.0, (height - 1.0) / 2.0];
        Some(Fill { texture: Cow::Borrowed(texture), place: rows(&(shift(middle) * turn(0.0, zoom))), tint: [1.0; 3] })
    }
}

fn rows(map: &Map) -> [[f32; 3]; 2] {
    [0, 1].map(|r| [0, 1, 2].map(|c| map[(r, c)] as f32))
}

/// A little brighter, darker or coloured than the picture.
fn tint(dice: &mut Dice) -> [f32; 3] {
    let all = dice.ratio(0.7, 1.15);
    [0; 3].map(|_| (all * dice.ratio(0.93, 1.07)) as f32)
}

/// The files below a folder, by name.
fn listed(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let refused = |source| Error::Folder { folder: folder.into(), source };
    let (mut files, mut folders) = (Vec::new(), vec![folder.to_owned()]);
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).map_err(refused)? {
            let path = entry.map_err(refused)?.path();
            let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            if path.is_dir() {
                folders.push(path);
            } else if ["png", "jpg", "jpeg", "ppm", "pgm"].contains(&ending.as_str()) {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

/// A texture by formula.
fn made(dice: &mut Dice) -> Texture {
    let side = MADE_SIDE;
    let palette: [[f64; 3]; 3] = [0; 3].map(|_| {
        let light = dice.even(20.0, 235.0);
        [0; 3].map(|_| (light * dice.ratio(0.7, 1.4)).clamp(5.0, 250.0))
    });
    let (seed, kind) = (dice.pick(1 << 30) as u32, dice.pick(4));
    let (grain, rough, pitch) = (dice.ratio(24.0, 160.0), dice.even(0.5, 0.8), dice.ratio(14.0, 70.0));
    let pixel = |at: usize| {
        let (x, y) = ((at % side) as f64, (at / side) as f64);
        let detail = octaves(x, y, grain, rough, seed);
        let broad = octaves(y + 90.0, x, grain * 1.7, 0.45, seed ^ 0x55);
        let mark = match kind {
            0 => (0.5 + 4.0 * (broad - 0.5)).clamp(0.0, 1.0),
            1 => cells(x, y, pitch, seed),
            2 => bricks(x, y, pitch, seed),
            _ => 0.5 + 0.5 * (TAU * (x + 30.0 * broad) / pitch).sin(),
        };
        let light = 0.45 + 1.1 * detail;
        let colour = |c: usize| {
            let ground = palette[0][c] + mark * (palette[1][c] - palette[0][c]);
            let mixed = ground + 0.5 * (broad - 0.5).max(0.0) * (palette[2][c] - ground);
            (mixed * light).clamp(0.0, 255.0) as u8
        };
        [colour(0), colour(1), colour(2), 255]
    };
    Texture::endless(side, side, (0..side * side).map(pixel).collect())
}

/// Noise of halving wavelengths, 0…1 about.
fn octaves(x: f64, y: f64, longest: f64, rough: f64, seed: u32) -> f64 {
    let (mut sum, mut weight, mut total, mut length) = (0.0, 1.0, 0.0, longest);
    for octave in 0..6 {
        let (sine, cosine) = (0.7 * f64::from(octave) + 0.3).sin_cos();
        sum += weight * smooth(x * cosine - y * sine, x * sine + y * cosine, length, seed ^ octave);
        total += weight;
        (weight, length) = (weight * rough, length * 0.5);
        if length < 2.0 {
            break;
        }
    }
    sum / total
}

/// Value noise of one wavelength, 0…1.
fn smooth(x: f64, y: f64, length: f64, seed: u32) -> f64 {
    let (x, y) = (x / length, y / length);
    let (column, row) = (x.floor(), y.floor());
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (ease(x - column), ease(y - row));
    let at = |i: f64, j: f64| hashed(i as i32, j as i32, seed);
    let upper = at(column, row) * (1.0 - fx) + at(column + 1.0, row) * fx;
    let lower = at(column, row + 1.0) * (1.0 - fx) + at(column + 1.0, row + 1.0) * fx;
    upper * (1.0 - fy) + lower * fy
}

/// Pebbles: a shade for the nearest of scattered points, darker between them.
fn cells(x: f64, y: f64, pitch: f64, seed: u32) -> f64 {
    let (column, row) = ((x / pitch).floor() as i32, (y / pitch).floor() as i32);
    let (mut nearest, mut next, mut shade) = (f64::INFINITY, f64::INFINITY, 0.0);
    for (i, j) in (-1..=1).flat_map(|i| (-1..=1).map(move |j| (column + i, row + j))) {
        let (px, py) = (f64::from(i) + hashed(i, j, seed), f64::from(j) + hashed(i, j, seed ^ 1));
        let distance = (x / pitch - px).hypot(y / pitch - py);
        if distance < nearest {
            (next, nearest, shade) = (nearest, distance, hashed(i, j, seed ^ 2));
        } else {
            next = next.min(distance);
        }
    }
    if next - nearest < 0.08 { 0.0 } else { 0.2 + 0.8 * shade }
}

fn bricks(x: f64, y: f64, pitch: f64, seed: u32) -> f64 {
    let row = (y / pitch).floor();
    let x = x + if row.rem_euclid(2.0) < 1.0 { 0.0 } else { pitch };
    let column = (x / (2.0 * pitch)).floor();
    let (fx, fy) = (x - 2.0 * pitch * column, y - pitch * row);
    if fx < 2.5 || fy < 2.5 { 0.0 } else { 0.4 + 0.6 * hashed(column as i32, row as i32, seed) }
}

/// A value of 0…1 for a lattice point.
fn hashed(i: i32, j: i32, seed: u32) -> f64 {
    let mut h =
        i.cast_unsigned().wrapping_mul(0x9e37_79b1) ^ j.cast_unsigned().wrapping_mul(0x85eb_ca77).rotate_left(13);
    h = (h ^ seed.wrapping_mul(0xc2b2_ae3d)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 15)).wrapping_mul(0x297a_2d39);
    h = (h ^ (h >> 13)).wrapping_mul(0x85eb_ca6b);
    f64::from(h ^ (h >> 16)) / 4_294_967_296.0
}
