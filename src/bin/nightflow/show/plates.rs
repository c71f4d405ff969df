//! One step or pair as panels of equal size, and as one sheet with titles, figures and legend.

use image::{Rgb, RgbImage, imageops};
use nightflow::{
    flow::wheel,
    publish::paint::{self, LINE, PAPER, UNKNOWN},
};

const MARGIN: u32 = 14;
/// A panel is at least this wide, in whole steps of the frame.
const PANEL_MIN: u32 = 400;
/// Side of the colour wheel.
pub const WHEEL: u32 = 120;
const SCALE: u32 = 170;

/// What one step or pair shows, undrawn, so that all can be drawn to one scale.
#[derive(Default)]
pub struct Plate {
    /// Begins the names of its files.
    pub name: String,
    /// One line above the panels.
    pub title: String,
    /// Figures below the panels.
    pub lines: Vec<String>,
    /// Frames with their titles.
    pub frames: Vec<(&'static str, RgbImage)>,
    /// Columns and rows of what follows.
    pub grid: [usize; 2],
    /// The flow; NaN where it is not known.
    pub flow: Vec<[f32; 2]>,
    /// What the flow is called.
    pub flow_title: &'static str,
    /// 0…1.
    pub confidence: Option<Vec<f32>>,
    /// The true flow; NaN where it is not known.
    pub truth: Option<Vec<[f32; 2]>>,
    /// Where the older frame's point is still seen in the newer.
    pub seen: Option<Vec<bool>>,
}

/// The scale that all plates are drawn to.
#[derive(Debug, Clone, Copy)]
pub struct Look {
    /// Pixels at the rim of the wheel.
    pub longest: f32,
    /// Pixels at the end of the error's scale.
    pub error_max: f32,
    /// Which legends are needed.
    pub confidence: bool,
    /// As above.
    pub error: bool,
}

/// A panel, ready to be saved.
pub struct Panel {
    /// Ends its file's name.
    pub key: &'static str,
    /// Stands above it.
    pub title: String,
    /// As large as all others of the plate.
    pub picture: RgbImage,
}

impl Plate {
    /// End-point errors, NaN where the truth is not known; empty without a truth.
    pub fn errors(&self) -> Vec<f32> {
        let truth = self.truth.iter().flatten();
        self.flow.iter().zip(truth).map(|([u, v], [tu, tv])| (u - tu).hypot(v - tv)).collect()
    }

    /// The size of every panel.
    fn size(&self) -> [u32; 2] {
        let [columns, rows] = self.frames.first().map_or(self.grid.map(|side| side as u32), |(_, frame)| {
            let (width, height) = frame.dimensions();
            [width, height]
        });
        let zoom = PANEL_MIN.div_ceil(columns.max(1)).max(1);
        [columns * zoom, rows * zoom]
    }

    /// Cells of the grid as a picture; every cell is a block.
    fn cells(&self, colour: impl Fn(usize) -> [u8; 3]) -> RgbImage {
        let ([width, height], [columns, rows]) = (self.size(), self.grid);
        RgbImage::from_fn(width, height, |x, y| {
            let column = (x as usize * columns / width as usize).min(columns - 1);
            let row = (y as usize * rows / height as usize).min(rows - 1);
            Rgb(colour(row * columns + column))
        })
    }

    /// All panels: frames, flow, confidence, truth, what stays in sight, error.
    pub fn panels(&self, look: &Look) -> Vec<Panel> {
        let [width, height] = self.size();
        let mut panels = Vec::new();
        for (index, (title, frame)) in self.frames.iter().enumerate() {
            let picture = imageops::resize(frame, width, height, imageops::FilterType::Nearest);
            panels.push(Panel { key: ["frame_a", "frame_b"][index % 2], title: (*title).into(), picture });
        }
        let wheel = |vectors: &[[f32; 2]]| {
            self.cells(|cell| {
                let [u, v] = vectors[cell];
                if u.is_finite() && v.is_finite() { wheel::colour(u, v, look.longest) } else { UNKNOWN }
            })
        };
        panels.push(Panel { key: "flow", title: self.flow_title.into(), picture: wheel(&self.flow) });
        if let Some(confidence) = &self.confidence {
            let picture = self.cells(|cell| paint::confidence(confidence[cell]));
            panels.push(Panel { key: "confidence", title: "confidence".into(), picture });
        }
        if let Some(seen) = &self.seen {
            let picture = self.cells(|cell| if seen[cell] { [255; 3] } else { [40, 40, 46] });
            panels.push(Panel { key: "seen", title: "still seen in frame 2 (black: not)".into(), picture });
        }
        if let Some(truth) = &self.truth {
            panels.push(Panel { key: "truth", title: "true flow".into(), picture: wheel(truth) });
            let errors = self.errors();
            let picture = self.cells(|cell| match errors[cell] {
                error if error.is_nan() => UNKNOWN,
                error => paint::error(error / look.error_max),
            });
            let mean = super::summed(&errors).map_or("no truth".into(), |[mean, _]| format!("mean {mean:.2} px"));
            panels.push(Panel { key: "error", title: format!("end-point error, {mean}"), picture });
        }
        panels
    }

    /// All panels on one sheet, as it can stand alone in a document.
    pub fn sheet(&self, panels: &[Panel], look: &Look) -> RgbImage {
        let columns = match panels.len() {
            0 | 1 => 1,
            2 | 4 => 2,
            _ => 3,
        };
        let rows = panels.len().div_ceil(columns) as u32;
        let [width, height] = self.size();
        let legend = WHEEL.max(LINE * self.lines.len() as u32);
        let wide = MARGIN + columns as u32 * (width + MARGIN);
        let wide = wide.max(legend_width(look) + 2 * MARGIN);
        let high = MARGIN + LINE + rows * (LINE + height + MARGIN) + legend + MARGIN;
        let mut canvas = RgbImage::from_pixel(wide, high, PAPER);
        paint::write(&mut canvas, MARGIN, MARGIN, &self.title);
        for (index, panel) in panels.iter().enumerate() {
            let left = MARGIN + (index % columns) as u32 * (width + MARGIN);
            let top = MARGIN + LINE + (index / columns) as u32 * (LINE + height + MARGIN);
            paint::write(&mut canvas, left, top + 4, &panel.title);
            imageops::replace(&mut canvas, &panel.picture, i64::from(left), i64::from(top + LINE));
        }
        let below = high - legend - MARGIN;
        for (line, text) in self.lines.iter().enumerate() {
            paint::write(&mut canvas, MARGIN, below + line as u32 * LINE, text);
        }
        let drawn = draw_legend(look);
        imageops::replace(&mut canvas, &drawn, i64::from(wide - MARGIN - drawn.width()), i64::from(below));
        canvas
    }
}

fn legend_width(look: &Look) -> u32 {
    let scales = u32::from(look.confidence) + u32::from(look.error);
    WHEEL + 10 + paint::width("grey: unknown") + scales.min(1) * (SCALE + 2 * MARGIN)
}

/// The wheel with its length in pixels, and the scales of confidence and error.
pub fn draw_legend(look: &Look) -> RgbImage {
    let mut canvas = RgbImage::from_pixel(legend_width(look), WHEEL, PAPER);
    let mut left = 0;
    let mut top = 0;
    if look.confidence || look.error {
        if look.confidence {
            paint::write(&mut canvas, left, top, "confidence");
            paint::scale(&mut canvas, [left, top + 18], SCALE, paint::confidence, ["0", "1"]);
            top += 62;
        }
        if look.error {
            paint::write(&mut canvas, left, top, "end-point error");
            let end = format!("{} px", look.error_max);
            paint::scale(&mut canvas, [left, top + 18], SCALE, paint::error, ["0", &end]);
        }
        left += SCALE + 2 * MARGIN;
    }
    paint::wheel(&mut canvas, left, 0, WHEEL);
    left += WHEEL + 10;
    let rim = format!("rim: {} px", look.longest);
    for (line, text) in ["flow", &rim, "white: still", "grey: unknown"].into_iter().enumerate() {
        paint::write(&mut canvas, left, 12 + line as u32 * LINE, text);
    }
    canvas
}
