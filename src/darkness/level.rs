//! One noise level for an image, by the eigenvalues of its patches' covariance (Chen, Zhu and Heng, ICCV 2015).
//!
//! Patches of a clean image lie in a few dimensions: the covariance of 8 × 8 patches has some large eigenvalues, and
//! the rest would be nought. White noise of variance σ² adds σ² to each of them, so that the small ones scatter evenly
//! around σ². Of a set that scatters evenly, the mean is the median; large eigenvalues are taken away until it is so.
//!
//! Sharp texture has no dimension to spare, least of all in one plane or where the planes were sampled beside each
//! other, as a mosaic's are. So we look at the smoothest patches only, which the paper does not: of those of about the
//! same brightness the tenth with the least energy in the ten lowest frequencies. The noise is then taken from the
//! other frequencies, where the choice has left white noise as it was.
//!
//! On 65 photographs (512 pixels, sharp, 8 bits) with levels from 0 to 30 added, in 255ths: three planes, bias −0.36
//! (at 30) to +0.17 (at 0), worst 0.74, the same linearised within 0.94; one plane, median error 0.09 to 0.77, but up
//! to 12 where no part of the picture is smooth.
//!
//! What it can't know: noise that depends on the signal counts with about its mean variance over the image; noise that
//! was clipped, averaged with its neighbours (a demosaiced image) or compressed looks weaker than it was.

use nalgebra::DMatrix;

use super::plane;

/// Side of a patch, pixels.
pub const PATCH: usize = 8;
/// More patches than this are not looked at, so that a large image costs no more than a small one.
const PATCHES_MAX: usize = 65_536;
/// The part of them that is measured, the smoothest.
const SMOOTH: usize = 10;
/// Groups of like brightness, from each of which the smoothest are taken: or dark patches, which are smooth, would
/// speak for all.
const GROUPS: usize = 8;
/// Patches that are multiplied at once.
const BATCH: usize = 512;
/// Frequencies (u, v) with u + v up to this are low; there are ten.
const LOW: usize = 3;
/// Patches a value of a patch that there must be at least, and that are measured where there are so many: with fewer,
/// the small eigenvalues fall below σ².
const PATCHES_A_VALUE: [usize; 2] = [10, 40];

/// Why an image has no noise level.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// No plane.
    #[error(transparent)]
    Plane(#[from] plane::Error),
    /// Too few patches for the covariance.
    #[error("{width}×{height} pixels hold {found} patches of 8×8, at least {needed} are needed")]
    Small {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Patches.
        found: usize,
        /// Patches.
        needed: usize,
    },
}

/// The noise's standard deviation in one plane (`height` × `width`), in the unit of the values: for an image in 0…1,
/// 255 times this is the level on the 8-bit scale that the paper's table 1 counts in.
///
/// Right to one 255th from level 0 to 30 where some part of the picture is smooth; texture everywhere passes for noise, and
/// [`noise_level_rgb`] tells the two apart far better.
pub fn noise_level(plane: &[f32], width: usize, height: usize) -> Result<f64, Error> {
    level(&[plane], width, height)
}

/// The same over three planes (red, green, blue; each `height` × `width`): patches of 8 × 8 × 3, so that one level
/// comes out for all.
///
/// Where the planes' noise differs the level lies between theirs, below the root of the mean variance.
pub fn noise_level_rgb(planes: [&[f32]; 3], width: usize, height: usize) -> Result<f64, Error> {
    level(&planes, width, height)
}

fn level(planes: &[&[f32]], width: usize, height: usize) -> Result<f64, Error> {
    for values in planes {
        plane::check(values, width, height)?;
    }
    let room = |side: usize| (side + 1).saturating_sub(PATCH);
    let (found, needed) = (room(width) * room(height), PATCHES_A_VALUE[0] * PATCH * PATCH * planes.len());
    if found < needed {
        return Err(Error::Small { width, height, found, needed });
    }
    let waves = waves();
    let chosen = smooth(planes, width, corners(room(width), room(height)), &waves);
    let covariance = covariance(planes, width, &chosen);
    // Every plane's high frequencies, from the pixels of a patch.
    let (values, high) = (PATCH * PATCH, PATCH * PATCH - LOWS);
    let mut turn = DMatrix::zeros(high * planes.len(), values * planes.len());
    for plane in 0..planes.len() {
        turn.view_mut((plane * high, plane * values), (high, values)).copy_from(&waves.rows(LOWS, high));
    }
    let turned = &turn * covariance * turn.transpose();
    let mut eigenvalues: Vec<f64> = turned.symmetric_eigenvalues().iter().copied().collect();
    eigenvalues.sort_by(f64::total_cmp);
    Ok(evenly_scattered(&eigenvalues).max(0.0).sqrt())
}

/// How many frequencies are low, the mean among them.
const LOWS: usize = (LOW + 1) * (LOW + 2) / 2;

/// The cosine transform of a patch, one frequency a row, lowest first and the mean first of all.
fn waves() -> DMatrix<f64> {
    let wave = |k: usize, n: usize| {
        let norm = if k == 0 { 1.0 } else { 2.0_f64.sqrt() } / (PATCH as f64).sqrt();
        norm * (std::f64::consts::PI * (n as f64 + 0.5) * k as f64 / PATCH as f64).cos()
    };
    let mut frequencies: Vec<[usize; 2]> = (0..PATCH * PATCH).map(|i| [i % PATCH, i / PATCH]).collect();
    frequencies.sort_by_key(|[u, v]| u + v);
    DMatrix::from_fn(PATCH * PATCH, PATCH * PATCH, |row, pixel| {
        let [u, v] = frequencies[row];
        wave(u, pixel % PATCH) * wave(v, pixel / PATCH)
    })
}

/// Of each group of like brightness the patches with the least energy in the low frequencies.
fn smooth(planes: &[&[f32]], width: usize, corners: Vec<[usize; 2]>, waves: &DMatrix<f64>) -> Vec<[usize; 2]> {
    let low = waves.rows(0, LOWS).into_owned();
    let mut rated: Vec<(f64, f64, [usize; 2])> = Vec::with_capacity(corners.len());
    for batch in corners.chunks(BATCH) {
        let mut rates = vec![(0.0, 0.0); batch.len()];
        for plane in planes {
            let found = &low * patches(&[plane], width, batch);
            for (rate, column) in rates.iter_mut().zip(found.column_iter()) {
                rate.0 += column[0];
                rate.1 += column.rows(1, LOWS - 1).norm_squared();
            }
        }
        rated.extend(rates.into_iter().zip(batch).map(|((mean, energy), corner)| (mean, energy, *corner)));
    }
    rated.sort_by(|a, b| a.0.total_cmp(&b.0));
    let keep = (rated.len() / SMOOTH).max(PATCHES_A_VALUE[1] * PATCH * PATCH * planes.len()) / GROUPS;
    let group = rated.len().div_ceil(GROUPS);
    let mut chosen = Vec::with_capacity(keep * GROUPS);
    for group in rated.chunks_mut(group) {
        group.sort_by(|a, b| a.1.total_cmp(&b.1));
        chosen.extend(group.iter().take(keep).map(|rate| rate.2));
    }
    chosen
}

/// Columns and rows of the patches' corners: every `step`-th in reading order, as many as the limit allows. The step has
/// no factor in common with the number of columns, so that the corners spread over all columns, and the 8 × 8 blocks of
/// a compressed picture are met at every phase.
fn corners(columns: usize, rows: usize) -> Vec<[usize; 2]> {
    let mut step = (columns * rows).div_ceil(PATCHES_MAX);
    while common_factor(step, columns) > 1 {
        step += 1;
    }
    (0..columns * rows).step_by(step).map(|at| [at % columns, at / columns]).collect()
}

fn common_factor(a: usize, b: usize) -> usize {
    if b == 0 { a } else { common_factor(b, a % b) }
}

/// Patches, one a column, planes one after the other.
fn patches(planes: &[&[f32]], width: usize, corners: &[[usize; 2]]) -> DMatrix<f64> {
    let mut patches = DMatrix::zeros(PATCH * PATCH * planes.len(), corners.len());
    for (corner, mut patch) in corners.iter().zip(patches.column_iter_mut()) {
        let mut values = patch.iter_mut();
        for plane in planes {
            for row in corner[1]..corner[1] + PATCH {
                let from = row * width + corner[0];
                // The pixels come first: when they end, zip must not have taken a value more.
                for (pixel, value) in plane[from..from + PATCH].iter().zip(values.by_ref()) {
                    *value = f64::from(*pixel);
                }
            }
        }
    }
    patches
}

/// Covariance of the patches, one row and column a value of the patch.
fn covariance(planes: &[&[f32]], width: usize, corners: &[[usize; 2]]) -> DMatrix<f64> {
    let values = PATCH * PATCH * planes.len();
    let mut products = DMatrix::<f64>::zeros(values, values);
    let mut sums = DMatrix::<f64>::zeros(values, 1);
    for batch in corners.chunks(BATCH) {
        let patches = patches(planes, width, batch);
        products.gemm(1.0, &patches, &patches.transpose(), 1.0);
        sums += patches.column_sum();
    }
    let count = corners.len() as f64;
    let mean = sums / count;
    products / count - &mean * mean.transpose()
}

/// The mean of the eigenvalues (in rising order) that are left once so many of the largest are taken away that the
/// mean is the median: as many above it as below.
fn evenly_scattered(eigenvalues: &[f64]) -> f64 {
    let mut left = eigenvalues;
    let mut sum: f64 = left.iter().sum();
    while let [rest @ .., largest] = left {
        let mean = sum / left.len() as f64;
        let below = left.partition_point(|value| *value < mean);
        let above = left.len() - left.partition_point(|value| *value <= mean);
        if above >= below {
            return mean;
        }
        sum -= largest;
        left = rest;
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::darkness::noise::Normals;

    #[test]
    fn mean_and_median_meet_where_only_noise_is_left() {
        assert_eq!(evenly_scattered(&[1.0, 2.0, 3.0]), 2.0);
        assert_eq!(evenly_scattered(&[1.0, 2.0, 3.0, 50.0, 900.0]), 2.0);
        assert_eq!(evenly_scattered(&[4.0; 64]), 4.0);
        assert_eq!(evenly_scattered(&[]), 0.0);
    }

    #[test]
    fn pure_noise_has_its_own_level_and_none_has_none() {
        let mut draws = Normals::new(5, 0);
        let noise: Vec<f32> = (0..160 * 120).map(|_| 0.5 + 0.05 * draws.draw() as f32).collect();
        let found = noise_level(&noise, 160, 120).unwrap();
        assert!((found / 0.05 - 1.0).abs() < 0.03, "{found}");
        let level = noise_level(&[0.3; 64 * 48], 64, 48).unwrap();
        assert!(level < 1e-6, "{level}");
    }

    #[test]
    fn what_it_cannot_measure_is_refused_in_numbers() {
        let said = |result: Result<f64, Error>| result.unwrap_err().to_string();
        assert_eq!(said(noise_level(&[0.0; 10], 4, 3)), "a plane of 4×3 needs 12 values, found 10");
        assert_eq!(
            said(noise_level(&[0.0; 400], 20, 20)),
            "20×20 pixels hold 169 patches of 8×8, at least 640 are needed"
        );
        assert_eq!(said(noise_level(&[], 0, 0)), "0×0 pixels hold 0 patches of 8×8, at least 640 are needed");
        let mut plane = vec![0.5; 64 * 64];
        plane[3 * 64 + 7] = f32::NAN;
        assert_eq!(said(noise_level(&plane, 64, 64)), "pixel (7, 3) is NaN, expected a finite value");
        let pixels = vec![0.5; 64 * 64];
        assert!(noise_level_rgb([&pixels, &plane, &pixels], 64, 64).is_err());
    }
}
