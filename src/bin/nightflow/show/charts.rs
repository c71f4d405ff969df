//! Figures over time as small SVG charts that stand in the page itself.

use std::fmt::Write;

const SIZE: [f64; 2] = [720.0, 190.0];
const PLOT: [f64; 4] = [54.0, 26.0, 706.0, 164.0];
/// More points than this can't be seen apart.
const POINTS_MAX: usize = 1400;

/// A line with its name and colour; `dashed` for truth.
pub struct Line {
    /// Stands in the legend.
    pub name: &'static str,
    /// CSS.
    pub colour: &'static str,
    /// Broken, for what is true.
    pub dashed: bool,
    /// (seconds, value); a value that is not finite breaks the line.
    pub points: Vec<(f64, f64)>,
}

/// A chart; empty where no line has two points.
pub fn chart(title: &str, unit: &str, lines: &[Line], logarithmic: bool) -> String {
    let finite = |line: &Line| line.points.iter().filter(|(_, y)| y.is_finite()).count() >= 2;
    let lines: Vec<&Line> = lines.iter().filter(|line| finite(line)).collect();
    if lines.is_empty() {
        return String::new();
    }
    let map = |y: f64| if logarithmic { y.max(1e-5).log10() } else { y };
    let all = || lines.iter().flat_map(|line| line.points.iter().copied()).filter(|(_, y)| y.is_finite());
    let end = all().fold(1e-6_f64, |end, (x, _)| end.max(x));
    let start = if logarithmic { f64::INFINITY } else { 0.0 };
    let (low, high) = all().fold((start, f64::NEG_INFINITY), |(low, high), (_, y)| (low.min(map(y)), high.max(map(y))));
    let (low, high) = if logarithmic { (low.floor(), high.ceil().max(low.floor() + 1.0)) } else { padded(low, high) };
    let [left, top, right, bottom] = PLOT;
    let place =
        |x: f64, y: f64| [left + x / end * (right - left), bottom - (map(y) - low) / (high - low) * (bottom - top)];
    let [wide, tall] = SIZE;
    let mut svg =
        format!("<figure class=\"chart\"><svg viewBox=\"0 0 {wide} {tall}\" role=\"img\" aria-label=\"{title}\">");
    let _ = write!(svg, "<text x=\"{left}\" y=\"15\" class=\"t\">{title}</text>");
    for tick in ticks(low, high, logarithmic) {
        let [_, y] = place(0.0, if logarithmic { 10_f64.powf(tick) } else { tick });
        let label = if logarithmic { number(10_f64.powf(tick)) } else { number(tick) };
        let _ = write!(svg, "<line x1=\"{left}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\" class=\"g\"/>");
        let _ = write!(svg, "<text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>", left - 6.0, y + 4.0);
    }
    let _ = write!(svg, "<text x=\"{right}\" y=\"184\" text-anchor=\"end\">{} s</text>", number(end));
    let _ = write!(svg, "<text x=\"{left}\" y=\"184\">0 s, {unit}</text>");
    let mut from_right = right;
    for line in &lines {
        let dash = if line.dashed { " stroke-dasharray=\"5 4\"" } else { "" };
        for run in line.points.chunk_by(|a, b| a.1.is_finite() == b.1.is_finite()).filter(|run| run[0].1.is_finite()) {
            let step = run.len().div_ceil(POINTS_MAX);
            let path: Vec<String> =
                run.iter().step_by(step).map(|(x, y)| place(*x, *y)).map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
            let _ = write!(svg, "<polyline points=\"{}\" stroke=\"{}\"{dash}/>", path.join(" "), line.colour);
        }
        let _ = write!(
            svg,
            "<text x=\"{from_right:.0}\" y=\"15\" text-anchor=\"end\" style=\"fill:{}\">{}</text>",
            line.colour, line.name
        );
        from_right -= 14.0 + 7.2 * line.name.len() as f64;
    }
    svg.push_str("</svg></figure>\n");
    svg
}

fn padded(low: f64, high: f64) -> (f64, f64) {
    let room = 0.06 * (high - low).max(1e-3);
    (if low < 0.0 { low - room } else { 0.0 }, high + room)
}

/// Three to six round values between the ends.
fn ticks(low: f64, high: f64, logarithmic: bool) -> Vec<f64> {
    let rough = (high - low) / 4.0;
    let ten = 10_f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|step| step * ten).find(|step| *step >= rough).unwrap_or(ten);
    let step = if logarithmic { 1.0 } else { step };
    let first = (low / step).ceil() as i64;
    let last = (high / step).floor() as i64;
    (first..=last).map(|at| at as f64 * step).collect()
}

fn number(value: f64) -> String {
    let text = format!("{value:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
