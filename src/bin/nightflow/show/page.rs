//! The page: facts, legend, charts, pictures and a table, in one HTML file that needs no network.

use std::{fmt::Write, path::Path};

use anyhow::{Context, Result};
use image::RgbImage;
use nightflow::publish::paint;

use super::{
    Row, Story,
    charts::{Line, chart},
    plates::{Look, Plate, draw_legend},
};

const STYLE: &str = "\
:root{color-scheme:light}body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1500px;padding:0 1.5rem;\
background:#fafaf8;color:#202024}h1{font-size:1.5rem;margin:0 0 .5rem}h2{font-size:1.05rem;margin:2rem 0 .3rem}\
dl{display:grid;grid-template-columns:max-content 1fr;gap:.1rem 1rem;margin:.5rem 0 1rem}dt{color:#66666c}dd{margin:0}\
.row{display:grid;grid-template-columns:repeat(auto-fit,minmax(300px,1fr));gap:.8rem}figure{margin:0}\
figure img{width:100%;display:block;image-rendering:pixelated;background:#e4e4e2}figcaption{font-size:.85rem;color:#44444a}\
.legend{width:auto;max-width:100%}.lines{font-size:.9rem;margin:.1rem 0 .5rem;color:#44444a}\
.charts{display:grid;grid-template-columns:repeat(auto-fit,minmax(460px,1fr));gap:.6rem}\
.chart svg{width:100%;background:#fff;border:1px solid #e2e2de}.chart text{font-size:12px;fill:#55555b}\
.chart .t{font-size:13px;fill:#202024}.chart .g{stroke:#e8e8e4}\
.chart polyline{fill:none;stroke-width:1.6}table{border-collapse:collapse;font-variant-numeric:tabular-nums;\
font-size:.85rem}td,th{padding:.12rem .7rem;text-align:right;border-bottom:1px solid #e6e6e2}\
td:first-child,th:first-child,td.l,th.l{text-align:left}.scroll{max-height:32rem;overflow:auto;border:1px solid #e6e6e2}\
.bad{color:#b3261e}.meh{color:#8a5a00}";

/// The page that is being written.
pub struct Page {
    html: String,
    pictures: usize,
}

impl Page {
    /// Draws every plate to one scale, writes `index.html`, and gives the number of pictures.
    pub fn draw(story: &Story, out: &Path, longest: Option<f32>, error_max: Option<f32>) -> Result<usize> {
        let look = look(&story.plates, longest, error_max);
        let mut page = Page { html: String::new(), pictures: 0 };
        page.head(story);
        page.save(&draw_legend(&look), out, "legend.png")?;
        page.html.push_str("<img class=\"legend\" src=\"legend.png\" alt=\"colour wheel and scales\">\n");
        page.charts(&story.rows);
        for plate in &story.plates {
            page.plate(plate, &look, out)?;
        }
        page.table(&story.rows);
        page.html.push_str("</body></html>\n");
        let path = out.join("index.html");
        std::fs::write(&path, page.html).with_context(|| format!("{} can't be written", path.display()))?;
        Ok(page.pictures)
    }

    fn head(&mut self, story: &Story) {
        let title = escape(&story.title);
        let _ = write!(
            self.html,
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width\"><title>{title}</title><style>{STYLE}</style></head>\n\
             <body><h1>{title}</h1>\n<dl>"
        );
        for (name, value) in &story.facts {
            let _ = writeln!(self.html, "<dt>{}</dt><dd>{}</dd>", escape(name), escape(value));
        }
        self.html.push_str("</dl>\n");
    }

    fn charts(&mut self, rows: &[Row]) {
        let series = |value: &dyn Fn(&Row) -> Option<f64>| -> Vec<(f64, f64)> {
            rows.iter().filter_map(|row| Some((row.seconds?, value(row).unwrap_or(f64::NAN)))).collect()
        };
        let line = |name, colour, dashed, points| Line { name, colour, dashed, points };
        let errors = [
            line("mean", "#b3261e", false, series(&|row| row.errors.map(|[mean, _]| f64::from(mean)))),
            line("90 %", "#d98c86", false, series(&|row| row.errors.map(|[_, ninth]| f64::from(ninth)))),
        ];
        let axes = [("forward", "#cc3311"), ("left", "#0077bb"), ("up", "#00995a")];
        let velocity = |true_one: bool| {
            let value = move |row: &Row, axis: usize| {
                let velocity = if true_one { row.true_velocity } else { row.velocity };
                velocity.map(|velocity| velocity[axis])
            };
            let name = move |axis: usize| if true_one { "" } else { axes[axis].0 };
            (0..3).map(move |axis| line(name(axis), axes[axis].1, true_one, series(&|row| value(row, axis))))
        };
        let velocities: Vec<Line> = velocity(false).chain(velocity(true)).collect();
        let confidence = [line("", "#33558b", false, series(&|row| row.confidence.map(f64::from)))];
        let light = [line("", "#202024", false, series(&|row| row.raw_mean.map(f64::from)))];
        let drawn = [
            chart("end-point error", "px", &errors, false),
            chart("velocity of the body (dashed: true)", "m/s", &velocities, false),
            chart("mean confidence", "0 to 1", &confidence, false),
            chart("raw mean above black", "1 = white", &light, true),
        ];
        if drawn.iter().any(|chart| !chart.is_empty()) {
            let _ = writeln!(self.html, "<div class=\"charts\">{}</div>", drawn.concat());
        }
    }

    fn plate(&mut self, plate: &Plate, look: &Look, out: &Path) -> Result<()> {
        let panels = plate.panels(look);
        let sheet = format!("{}.png", plate.name);
        self.save(&plate.sheet(&panels, look), out, &sheet)?;
        let _ = writeln!(
            self.html,
            "<h2 id=\"{name}\">{title}</h2><p class=\"lines\">{lines} · <a href=\"{sheet}\">as one picture</a></p><div \
             class=\"row\">",
            name = escape(&plate.name),
            title = escape(&plate.title),
            lines = escape(&plate.lines.join(" · ")),
            sheet = escape(&sheet),
        );
        for panel in &panels {
            let file = format!("{}_{}.png", plate.name, panel.key);
            self.save(&panel.picture, out, &file)?;
            let (file, title) = (escape(&file), escape(&panel.title));
            let _ = writeln!(
                self.html,
                "<figure><img loading=\"lazy\" src=\"{file}\" alt=\"{title}\"><figcaption>{title}</figcaption></figure>"
            );
        }
        self.html.push_str("</div>\n");
        Ok(())
    }

    fn table(&mut self, rows: &[Row]) {
        let any = |has: &dyn Fn(&Row) -> bool| rows.iter().any(has);
        let (timed, stated) = (any(&|row| row.seconds.is_some()), any(&|row| row.state.is_some()));
        let judged = any(&|row| row.errors.is_some());
        self.html.push_str("<h2>all figures</h2><div class=\"scroll\"><table><tr><th>name</th>");
        for (shown, head) in [(timed, "seconds"), (stated, "raw mean"), (stated, "confidence")] {
            let _ = if shown { write!(self.html, "<th>{head}</th>") } else { Ok(()) };
        }
        for (shown, head) in [(judged, "EPE, px"), (judged, "90 %, px")] {
            let _ = if shown { write!(self.html, "<th>{head}</th>") } else { Ok(()) };
        }
        let velocity = if stated { "<th class=\"l\">state</th><th class=\"l\">velocity</th>" } else { "" };
        let _ = writeln!(self.html, "{velocity}</tr>");
        let cell = |value: Option<f64>, digits: usize| match value {
            Some(value) => format!("<td>{value:.digits$}</td>"),
            None => "<td>–</td>".to_owned(),
        };
        for row in rows {
            let _ = write!(self.html, "<tr><td>{}</td>", escape(&row.name));
            if timed {
                self.html.push_str(&cell(row.seconds, 3));
            }
            if stated {
                self.html.push_str(&cell(row.raw_mean.map(f64::from), 4));
                self.html.push_str(&cell(row.confidence.map(f64::from), 2));
            }
            if judged {
                self.html.push_str(&cell(row.errors.map(|[mean, _]| mean.into()), 2));
                self.html.push_str(&cell(row.errors.map(|[_, ninth]| ninth.into()), 2));
            }
            if let Some(state) = &row.state {
                let class = match state.split(':').next() {
                    Some("BLIND") => "l bad",
                    Some("DEGRADED") => "l meh",
                    _ => "l",
                };
                let (state, velocity) = (escape(state), escape(&row.velocity_words));
                let _ = write!(self.html, "<td class=\"{class}\">{state}</td><td class=\"l\">{velocity}</td>");
            }
            self.html.push_str("</tr>\n");
        }
        self.html.push_str("</table></div>\n");
    }

    fn save(&mut self, picture: &RgbImage, out: &Path, name: &str) -> Result<()> {
        let path = out.join(name);
        picture.save(&path).with_context(|| format!("{} can't be written", path.display()))?;
        self.pictures += 1;
        Ok(())
    }
}

/// One scale for all plates: the 99th percentile of the true lengths, or of the flow's own where no truth is known, and
/// the 95th of the errors, each rounded up.
fn look(plates: &[Plate], longest: Option<f32>, error_max: Option<f32>) -> Look {
    let length = |[u, v]: &[f32; 2]| u.hypot(*v);
    let lengths: Vec<f32> = if plates.iter().any(|plate| plate.truth.is_some()) {
        plates.iter().flat_map(|plate| plate.truth.iter().flatten().map(length)).collect()
    } else {
        plates.iter().flat_map(|plate| plate.flow.iter().map(length)).collect()
    };
    let errors: Vec<f32> = plates.iter().flat_map(Plate::errors).collect();
    let error = !errors.is_empty();
    Look {
        longest: longest.unwrap_or_else(|| paint::round_up(percentile(lengths, 99).max(1.0))),
        error_max: error_max.unwrap_or_else(|| paint::round_up(percentile(errors, 95).max(0.1))),
        confidence: plates.iter().any(|plate| plate.confidence.is_some()),
        error,
    }
}

fn percentile(mut values: Vec<f32>, part: usize) -> f32 {
    values.retain(|value| value.is_finite());
    if values.is_empty() {
        return 1.0;
    }
    let at = (values.len() - 1) * part / 100;
    *values.select_nth_unstable_by(at, f32::total_cmp).1
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
