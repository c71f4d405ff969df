//! The golden output: two images by formula, and the flow that the network's exporter noted for them.

use crate::{
    exposure::Exposed,
    flow::{
        Error, Precision,
        network::{Golden, Network, Raster, Slot},
        padding::Padded,
    },
};

/// Every eighth cell from the fourth on is noted.
const FIRST: usize = 4;
const STEP: usize = 8;

/// How far this machine's result lies from the noted one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// The greatest over all noted values, in pixels.
    pub worst: f32,
    /// What the exporter allows.
    pub tolerance: f32,
}

/// What fewer bits may change, in pixels. The picture is a pattern of one wavelength, on which matching is at its most
/// delicate.
const FEWER_BITS_PX: f32 = 0.5;

/// Runs the network on the golden images. `None` where it has none; an error where it is further off than allowed.
pub fn check(network: &mut dyn Network, precision: Precision) -> Result<Option<Deviation>, Error> {
    let Some(golden) = network.golden().cloned() else { return Ok(None) };
    let Golden { height, width, .. } = golden;
    let tolerance = match precision {
        Precision::Fp32 => golden.tolerance,
        Precision::Bf16 | Precision::Fp16 => golden.tolerance.max(FEWER_BITS_PX),
    };
    let (columns, rows) = (width / 4, height / 4);
    let noted = noted(columns, rows);
    if golden.flow.len() != 2 * noted.len() || golden.uncertainty.len() != noted.len() {
        return Err(Error::GoldenSize {
            cells: noted.len(),
            flow: golden.flow.len(),
            uncertainty: golden.uncertainty.len(),
        });
    }
    for (slot, moved) in [(Slot::A, (0, 0)), (Slot::B, (2, 1))] {
        network.describe(slot, &Padded::new(&picture(width, height, moved), 1))?;
    }
    let (mut flow, mut uncertainty) = (vec![0.0; columns * rows * 2], vec![0.0; columns * rows]);
    let raster = Raster { flow: &mut flow, uncertainty: &mut uncertainty };
    network.between(Slot::A, [1.0, 1.0], raster)?;
    let mut worst = 0.0f32;
    for (i, cell) in noted.into_iter().enumerate() {
        for (found, wanted) in [
            (flow[2 * cell], golden.flow[2 * i]),
            (flow[2 * cell + 1], golden.flow[2 * i + 1]),
            (uncertainty[cell], golden.uncertainty[i]),
        ] {
            let off = (found - wanted).abs();
            // Asked this way round, a NaN is refused.
            let near = off <= tolerance;
            worst = worst.max(off);
            if !near {
                let (row, column) = (cell / columns, cell % columns);
                return Err(Error::Golden { row, column, wanted, found, tolerance });
            }
        }
    }
    Ok(Some(Deviation { worst, tolerance }))
}

/// The noted cells' indices, row by row.
fn noted(columns: usize, rows: usize) -> Vec<usize> {
    let line = |end: usize| (FIRST..end).step_by(STEP);
    line(rows).flat_map(|row| line(columns).map(move |column| row * columns + column)).collect()
}

/// The golden picture moved by (x, y) pixels.
fn picture(width: usize, height: usize, moved: (i32, i32)) -> Exposed {
    let mut rgb = Vec::with_capacity(3 * width * height);
    for c in 0..3 {
        for y in 0..height {
            for x in 0..width {
                let (x, y) = (x as f64 - f64::from(moved.0), y as f64 - f64::from(moved.1));
                let wave = (0.20 * x + 0.13 * y + f64::from(c)).sin() * (0.17 * y - 0.05 * x).cos();
                rgb.push((0.4 + 0.25 * wave) as f32);
            }
        }
    }
    Exposed { width, height, scale: [1.0, 1.0], saturated: vec![0; width * height], rgb, ..Exposed::default() }
}
