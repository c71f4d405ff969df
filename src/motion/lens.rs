//! The calibrated camera: pixels of the frame become rays, distortion taken off.

use super::Error;
use crate::{clock::Stamp, wire::CameraInfo};

/// A lens that was calibrated.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Lens {
    focal: [f64; 2],
    centre: [f64; 2],
    binning: [f64; 2],
    corner: [f64; 2],
    model: Model,
    size: [u32; 2],
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Model {
    Pinhole,
    /// k1 k2 p1 p2 k3 k4 k5 k6.
    Radial([f64; 8]),
    /// k1 … k4 over the angle.
    Equidistant([f64; 4]),
}

impl Lens {
    /// Reads a calibration; `None` where it says that there is none.
    pub(super) fn read(info: &CameraInfo) -> Result<Option<Lens>, Error> {
        let stamp: Stamp = info.header.stamp.into();
        if info.k.iter().chain(&info.d).any(|value| !value.is_finite()) {
            return Err(Error::NotFinite { sensor: "calibration", stamp, what: "K or D" });
        }
        if info.k[0] == 0.0 || info.k[4] == 0.0 {
            return Ok(None);
        }
        let binning = [info.binning_x.max(1), info.binning_y.max(1)];
        let whole = [info.width, info.height];
        let part = [info.roi.width, info.roi.height];
        let shown = if part == [0, 0] { whole } else { part };
        Ok(Some(Lens {
            focal: [info.k[0], info.k[4]],
            centre: [info.k[2], info.k[5]],
            binning: binning.map(f64::from),
            corner: [f64::from(info.roi.x_offset), f64::from(info.roi.y_offset)],
            model: Model::read(&info.distortion_model, &info.d)?,
            size: [shown[0] / binning[0], shown[1] / binning[1]],
        }))
    }

    /// The pixel of the frame that a ray (x, y, 1) is seen at; `None` beyond the lens's field.
    pub(super) fn pixel(&self, ray: [f64; 2]) -> Option<[f64; 2]> {
        let distorted = self.model.distort(ray)?;
        Some(std::array::from_fn(|i| {
            let full = distorted[i] * self.focal[i] + self.centre[i];
            (full - self.corner[i] + 0.5) / self.binning[i] - 0.5
        }))
    }

    /// Columns and rows of the frames that this lens belongs to; zero when the calibration does not say.
    pub(super) fn size(&self) -> [u32; 2] {
        self.size
    }

    /// Frame pixels per unit of (x, y) at the centre.
    pub(super) fn focal(&self) -> f64 {
        0.5 * (self.focal[0] / self.binning[0] + self.focal[1] / self.binning[1])
    }

    /// The ray (x, y, 1) of a pixel of the frame, pixel centres at whole numbers; `None` where the lens has none.
    pub(super) fn ray(&self, pixel: [f64; 2]) -> Option<[f64; 2]> {
        let full: [f64; 2] = std::array::from_fn(|i| (pixel[i] + 0.5) * self.binning[i] - 0.5 + self.corner[i]);
        let distorted: [f64; 2] = std::array::from_fn(|i| (full[i] - self.centre[i]) / self.focal[i]);
        self.model.undistort(distorted)
    }
}

impl Model {
    fn read(name: &str, d: &[f64]) -> Result<Model, Error> {
        if d.iter().all(|k| *k == 0.0) && name != "equidistant" {
            return Ok(Model::Pinhole);
        }
        let coefficient = |i: usize| d.get(i).copied().unwrap_or(0.0);
        match name {
            "plumb_bob" => Ok(Model::Radial(std::array::from_fn(|i| if i < 5 { coefficient(i) } else { 0.0 }))),
            "rational_polynomial" => Ok(Model::Radial(std::array::from_fn(coefficient))),
            "equidistant" => Ok(Model::Equidistant(std::array::from_fn(coefficient))),
            other => Err(Error::Distortion { model: other.into() }),
        }
    }

    fn distort(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let r2 = x * x + y * y;
        match self {
            Model::Pinhole => Some([x, y]),
            Model::Radial(k) => {
                let above = 1.0 + ((k[4] * r2 + k[1]) * r2 + k[0]) * r2;
                let below = 1.0 + ((k[7] * r2 + k[6]) * r2 + k[5]) * r2;
                let radial = above / below;
                // Asked this way round, a NaN is nowhere. Beyond where the model folds back, no pixel is this ray's.
                let there = [
                    x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
                    y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
                ];
                let back = undistort_radial(k, there)?;
                ((back[0] - x).abs() + (back[1] - y).abs() < 1e-6).then_some(there)
            }
            Model::Equidistant(k) => {
                let length = r2.sqrt();
                if length < 1e-12 {
                    return Some([x, y]);
                }
                let angle = length.atan();
                let a2 = angle * angle;
                let bent = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))));
                Some([x * bent / length, y * bent / length])
            }
        }
    }

    fn undistort(&self, distorted: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Model::Pinhole => Some(distorted),
            Model::Radial(k) => undistort_radial(k, distorted),
            Model::Equidistant(k) => undistort_equidistant(k, distorted),
        }
    }
}

/// Newton's method with the model's own slope: four rounds where a fixed point takes fifteen. `None` beyond the radius
/// at which the model folds back, where two rays would have the same pixel.
fn undistort_radial(k: &[f64; 8], [xd, yd]: [f64; 2]) -> Option<[f64; 2]> {
    let [mut x, mut y] = [xd, yd];
    for _ in 0..20 {
        let r2 = x * x + y * y;
        let above = 1.0 + ((k[4] * r2 + k[1]) * r2 + k[0]) * r2;
        let below = 1.0 + ((k[7] * r2 + k[6]) * r2 + k[5]) * r2;
        let radial = above / below;
        if radial.is_nan() || radial <= 0.1 {
            return None;
        }
        let above_slope = (3.0 * k[4] * r2 + 2.0 * k[1]) * r2 + k[0];
        let below_slope = (3.0 * k[7] * r2 + 2.0 * k[6]) * r2 + k[5];
        let bend = 2.0 * (above_slope - radial * below_slope) / below;
        let off_x = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x) - xd;
        let off_y = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y - yd;
        let xx = radial + x * x * bend + 2.0 * k[2] * y + 6.0 * k[3] * x;
        let xy = x * y * bend + 2.0 * (k[2] * x + k[3] * y);
        let yy = radial + y * y * bend + 6.0 * k[2] * y + 2.0 * k[3] * x;
        let determinant = xx * yy - xy * xy;
        if determinant <= 0.01 {
            return None;
        }
        let step = [(yy * off_x - xy * off_y) / determinant, (xx * off_y - xy * off_x) / determinant];
        [x, y] = [x - step[0], y - step[1]];
        if step[0].abs() + step[1].abs() < 1e-12 {
            return Some([x, y]);
        }
    }
    None
}

fn undistort_equidistant(k: &[f64; 4], [xd, yd]: [f64; 2]) -> Option<[f64; 2]> {
    let measured = xd.hypot(yd);
    if measured < 1e-12 {
        return Some([xd, yd]);
    }
    let mut angle = measured;
    for _ in 0..20 {
        let a2 = angle * angle;
        let value = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3])))) - measured;
        let slope = 1.0 + a2 * (3.0 * k[0] + a2 * (5.0 * k[1] + a2 * (7.0 * k[2] + a2 * 9.0 * k[3])));
        if slope <= 0.1 {
            return None;
        }
        angle -= value / slope;
        if (value / slope).abs() < 1e-14 {
            break;
        }
    }
    // Beyond 80° a plane image has no room for the ray.
    if !(0.0..1.4).contains(&angle) {
        return None;
    }
    let stretch = angle.tan() / measured;
    Some([xd * stretch, yd * stretch])
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lens(model: &str, d: &[f64]) -> Lens {
        let mut info = CameraInfo {
            width: 1280,
            height: 960,
            distortion_model: model.into(),
            d: d.to_vec(),
            k: [700.0, 0.0, 650.0, 0.0, 690.0, 470.0, 0.0, 0.0, 1.0],
            binning_x: 2,
            binning_y: 2,
            ..CameraInfo::default()
        };
        (info.roi.x_offset, info.roi.y_offset) = (16, 8);
        Lens::read(&info).unwrap().unwrap()
    }

    proptest! {
        #[test]
        fn a_pixels_ray_is_seen_at_that_pixel(x in 0.0..600.0, y in 0.0..440.0) {
            for (model, d) in [
                ("plumb_bob", vec![0.0; 5]),
                ("plumb_bob", vec![-0.28, 0.07, 1e-3, -5e-4, 0.0]),
                ("rational_polynomial", vec![0.3, 0.02, 1e-4, 2e-4, 1e-3, 0.5, 0.04, 2e-3]),
                ("equidistant", vec![0.01, -0.004, 0.002, -0.001]),
            ] {
                let lens = lens(model, &d);
                let Some(ray) = lens.ray([x, y]) else { continue };
                let pixel = lens.pixel(ray).unwrap();
                prop_assert!((pixel[0] - x).abs() + (pixel[1] - y).abs() < 1e-6, "{model}: {pixel:?} of {x}, {y}");
            }
        }
    }

    #[test]
    fn where_a_lens_folds_back_nothing_is_seen() {
        let lens = lens("plumb_bob", &[-0.28, 0.0, 0.0, 0.0, 0.0]);
        assert!(lens.pixel([0.5, 0.0]).is_some());
        // x − 0.28 x³ is greatest at 1.09.
        assert_eq!(lens.pixel([1.3, 0.0]), None);
        assert_eq!(lens.pixel([f64::NAN, 0.0]), None);
    }
}
