//! The sink for eyes: what the camera saw, what was made of it, and the flow with its colour wheel, as PNG files;
//! and the velocity over time as a plot.

use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};

use super::{
    Error, Moved, Offer, Sink,
    paint::{self, PAPER, display, write},
    plot,
};
use crate::{
    exposure::Exposed,
    flow::{Flow, State, wheel},
};

const MARGIN: u32 = 12;
const CAPTION: u32 = paint::LINE;
const WHEEL: u32 = 108;
/// A panel is drawn at least this wide, in whole steps of the developed image.
const PANEL_MIN: u32 = 400;

/// Writes a picture of every so-many-th step into a folder, and the plot at the end.
pub struct Pictures {
    folder: PathBuf,
    every: u64,
    written: u64,
    track: Vec<plot::Moment>,
}

impl Pictures {
    /// Makes the folder and readies the sink.
    pub fn open(folder: &Path, every: u64) -> Result<Self, Error> {
        std::fs::create_dir_all(folder).map_err(|error| Error::Open {
            sink: "pictures",
            reason: format!("{} can't be made: {error}", folder.display()),
        })?;
        Ok(Self { folder: folder.into(), every: every.max(1), written: 0, track: Vec::new() })
    }

    /// How many pictures were written.
    pub fn written(&self) -> u64 {
        self.written
    }

    fn lost(what: String, error: impl std::fmt::Display) -> Error {
        Error::Lost { sink: "pictures", what, reason: error.to_string() }
    }
}

impl Sink for Pictures {
    fn name(&self) -> &'static str {
        "pictures"
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error> {
        self.track.push(plot::Moment::of(offer.moved));
        if !offer.moved.step.is_multiple_of(self.every) {
            return Ok(());
        }
        let path = self.folder.join(format!("flow_{:06}.png", offer.moved.step));
        draw(offer.moved, &offer.flow, offer.image)
            .save(&path)
            .map_err(|error| Self::lost(path.display().to_string(), error))?;
        self.written += 1;
        Ok(())
    }

    fn finish(&mut self) -> Result<(), Error> {
        let path = self.folder.join("velocity.svg");
        plot::velocity(&path, &self.track).map_err(|error| Self::lost(path.display().to_string(), error))
    }
}

/// Three panels: as seen, as scaled, and the flow over it; below them the figures of the step and the wheel.
pub fn draw(moved: &Moved, flow: &Flow<'_>, image: &Exposed) -> RgbImage {
    let zoom = PANEL_MIN.div_ceil(image.width.max(1) as u32).max(1);
    let (width, height) = (image.width as u32 * zoom, image.height as u32 * zoom);
    let top = MARGIN + CAPTION;
    let whole = [3 * width + 4 * MARGIN, top + height + MARGIN + WHEEL + MARGIN];
    let mut canvas = RgbImage::from_pixel(whole[0], whole[1], PAPER);
    let longest = longest(flow);
    let titles = ["raw, as the eye would see it", "scaled linearly", "optical flow, by confidence"];
    for (panel, title) in titles.into_iter().enumerate() {
        let left = MARGIN + panel as u32 * (width + MARGIN);
        write(&mut canvas, left, MARGIN, title);
        for y in 0..height {
            for x in 0..width {
                let (column, row) = ((x / zoom) as usize, (y / zoom) as usize);
                let colour = match panel {
                    0 => display(image, column, row, 1.0 / image.gain.max(1e-6)),
                    1 => display(image, column, row, 1.0),
                    _ => overlay(flow, image, column, row, longest),
                };
                canvas.put_pixel(left + x, top + y, Rgb(colour));
            }
        }
    }
    let below = top + height + MARGIN;
    for (line, text) in figures(moved).iter().enumerate() {
        write(&mut canvas, MARGIN, below + 4 + line as u32 * CAPTION, text);
    }
    legend(&mut canvas, whole[0] - MARGIN - WHEEL, below, longest);
    canvas
}

/// The step in words.
fn figures(moved: &Moved) -> [String; 4] {
    let state = match &moved.state {
        State::Ok => "OK".to_owned(),
        State::Degraded(cause) => format!("DEGRADED: {cause}"),
        State::Blind(cause) => format!("BLIND: {cause}"),
    };
    let velocity = match &moved.velocity {
        Ok(velocity) => {
            let [x, y, z] = velocity.linear;
            let unit = match velocity.scale {
                crate::motion::Scale::Metric { .. } => "m/s",
                crate::motion::Scale::PerDistance(_) => "1/s (per distance)",
            };
            format!("velocity forward {x:+.2}  left {y:+.2}  up {z:+.2} {unit}")
        }
        Err(lack) => format!("no velocity: {lack}"),
    };
    [
        format!(
            "step {}  stamp {}  interval {:.1} ms",
            moved.step,
            moved.newer,
            moved.newer.seconds_since(moved.older) * 1e3
        ),
        format!("raw mean {:.4} of white  gain {:.1}  confidence {:.2}", moved.raw_mean, moved.gain, moved.confidence),
        velocity,
        format!("state {state}"),
    ]
}

/// The 99th percentile of the vectors' lengths, at least one pixel, so that one wild vector doesn't bleach the rest.
fn longest(flow: &Flow<'_>) -> f32 {
    let mut lengths: Vec<f32> =
        flow.vectors.chunks_exact(2).map(|uv| uv[0].hypot(uv[1])).filter(|l| l.is_finite()).collect();
    if lengths.is_empty() {
        return 1.0;
    }
    let at = (lengths.len() - 1) * 99 / 100;
    let (_, longest, _) = lengths.select_nth_unstable_by(at, f32::total_cmp);
    longest.max(1.0)
}

/// Flow colour where it is trusted, the grey frame shining through where it isn't.
fn overlay(flow: &Flow<'_>, image: &Exposed, column: usize, row: usize, longest: f32) -> [u8; 3] {
    let grid = flow.grid;
    let cell_column = (column * grid.width / image.width.max(1)).min(grid.width - 1);
    let cell_row = (row * grid.height / image.height.max(1)).min(grid.height - 1);
    let cell = cell_row * grid.width + cell_column;
    let colour = wheel::colour(flow.vectors[2 * cell], flow.vectors[2 * cell + 1], longest);
    let [r, g, b] = display(image, column, row, 1.0);
    let grey = 0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b);
    let trust = 0.25 + 0.6 * flow.confidence[cell].clamp(0.0, 1.0);
    colour.map(|c| (trust * f32::from(c) + (1.0 - trust) * grey) as u8)
}

/// The colour wheel with the length that its rim stands for.
fn legend(canvas: &mut RgbImage, left: u32, top: u32, longest: f32) {
    paint::wheel(canvas, left, top, WHEEL);
    let text = format!("rim {longest:.1} px");
    write(canvas, left.saturating_sub(14 * 9), top + WHEEL / 2 - 8, &text);
}
