//! The velocity of a run over time, as an SVG.

use std::path::Path;

use plotters::prelude::*;

use super::Moved;
use crate::{clock::Stamp, motion::Scale};

/// What the plot keeps of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    stamp: Stamp,
    /// m/s, FLU; NaN where there is none.
    linear: [f64; 3],
    /// One standard deviation of each.
    deviation: [f64; 3],
    raw_mean: f32,
}

impl Moment {
    /// The plot's part of a step; a velocity that isn't metric has no place on a metric axis.
    pub fn of(moved: &Moved) -> Self {
        let metric = moved.velocity.as_ref().ok().filter(|v| matches!(v.scale, Scale::Metric { .. }));
        Self {
            stamp: moved.newer,
            linear: metric.map_or([f64::NAN; 3], |v| v.linear),
            deviation: metric.map_or([f64::NAN; 3], |v| std::array::from_fn(|i| v.covariance[i][i].sqrt())),
            raw_mean: moved.raw_mean,
        }
    }
}

const AXES: [(&str, RGBColor); 3] =
    [("forward", RGBColor(204, 51, 17)), ("left", RGBColor(0, 119, 187)), ("up", RGBColor(0, 153, 90))];

/// Draws the velocity with a band of two standard deviations, and below it how dark it was.
pub fn velocity(path: &Path, track: &[Moment]) -> Result<(), Box<dyn std::error::Error>> {
    let Some(first) = track.first() else { return Ok(()) };
    let root = SVGBackend::new(path, (960, 560)).into_drawing_area();
    root.fill(&WHITE)?;
    let (above, below) = root.split_vertically(390);
    let at = |moment: &Moment| moment.stamp.seconds_since(first.stamp);
    let end = track.last().map_or(1.0, at).max(1e-3);
    let finite = track.iter().flat_map(|m| m.linear).filter(|v| v.is_finite());
    let (low, high) = finite.fold((-0.5f64, 0.5f64), |(low, high), v| (low.min(v * 1.1), high.max(v * 1.1)));
    let mut chart = ChartBuilder::on(&above)
        .caption("velocity of the body (FLU), band of two standard deviations", ("sans-serif", 18))
        .margin(8)
        .x_label_area_size(24)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..end, low..high)?;
    chart.configure_mesh().y_desc("m/s").light_line_style(WHITE).draw()?;
    for (axis, (name, colour)) in AXES.into_iter().enumerate() {
        // A gap in the velocity is a gap in the line: blind is not still.
        for (part, run) in track.chunk_by(|a, b| a.linear[axis].is_finite() == b.linear[axis].is_finite()).enumerate() {
            if !run[0].linear[axis].is_finite() {
                continue;
            }
            let edge = |sign: f64| move |m: &Moment| (m.linear[axis] + sign * 2.0 * m.deviation[axis]).clamp(low, high);
            let mut band: Vec<(f64, f64)> = run.iter().map(|m| (at(m), edge(1.0)(m))).collect();
            band.extend(run.iter().rev().map(|m| (at(m), edge(-1.0)(m))));
            chart.draw_series(std::iter::once(Polygon::new(band, colour.mix(0.15))))?;
            let line = chart
                .draw_series(LineSeries::new(run.iter().map(|m| (at(m), m.linear[axis])), colour.stroke_width(2)))?;
            if part == 0 {
                line.label(name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            }
        }
    }
    chart.configure_series_labels().border_style(BLACK.mix(0.3)).background_style(WHITE.mix(0.8)).draw()?;
    let mut light = ChartBuilder::on(&below)
        .margin(8)
        .x_label_area_size(32)
        .y_label_area_size(64)
        .build_cartesian_2d(0.0..end, (1e-4f64..1.0f64).log_scale())?;
    light.configure_mesh().x_desc("seconds").y_desc("raw mean").y_labels(5).light_line_style(WHITE).draw()?;
    light.draw_series(LineSeries::new(
        track.iter().map(|m| (at(m), f64::from(m.raw_mean).max(1e-4))),
        BLACK.stroke_width(2),
    ))?;
    root.present()?;
    Ok(())
}
