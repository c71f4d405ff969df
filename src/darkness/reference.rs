//! Reference flow for pairs without a truth, as VBOF's was made: a strong network's on the brightest exposure of a scene.
//!
//! A network always answers, also where what it looks for is hidden in the other frame. So the flow back is computed too,
//! and a vector is believed where it comes back to where it began (Sundaram, Brox and Keutzer 2010): with F there, B back,
//! and y = x + F(x) inside the frame,
//!
//! ```text
//! |F(x) + B(y)|² ≤ 0.01 (|F(x)|² + |B(y)|²) + 0.5
//! ```
//!
//! What is not believed is unknown, and nobody is judged by it. The check finds what is hidden and what is guessed; it
//! does not find what is wrong both ways alike.

use std::fmt::Write as _;

use super::{
    datasets::{self, Item, Kind, Skipped},
    flow_files::Field,
};

/// Part of the squared lengths that there and back may differ by, squared.
const PART: f64 = 0.01;
/// Squared pixels that they may differ by in any case.
const SLACK: f64 = 0.5;

/// Of a smaller part nothing is made: where there is nothing to see, some vectors come back by chance, about one of a thousand.
pub const VALID_MIN: f64 = 0.1;

/// What two flows agree on.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// The flow there, known only where the flow back agrees.
    pub field: Field,
    /// Part of all pixels that is known, 0…1.
    pub valid: f64,
    /// Median length of the known vectors, px; not a number where there is none.
    pub length: f64,
    /// Median of |F(x) + B(x + F(x))| over all pixels that stay in the frame, px.
    pub apart: f64,
}

/// Checks the flow there by the flow back; `None` where their sizes differ.
pub fn check(forward: &Field, backward: &Field) -> Option<Checked> {
    if (forward.width, forward.height) != (backward.width, backward.height) {
        return None;
    }
    let count = forward.vectors.len();
    let (mut valid, mut lengths, mut aparts) = (vec![false; count], vec![], vec![]);
    for (at, valid) in valid.iter_mut().enumerate().filter(|(at, _)| forward.known(*at)) {
        let there = forward.vectors[at].map(f64::from);
        let target = [(at % forward.width) as f64 + there[0], (at / forward.width) as f64 + there[1]];
        let Some(back) = between(backward, target) else { continue };
        let apart = (there[0] + back[0]).powi(2) + (there[1] + back[1]).powi(2);
        let [long, long_back] = [there, back].map(|[u, v]| u * u + v * v);
        aparts.push(apart.sqrt());
        if apart <= PART * (long + long_back) + SLACK {
            *valid = true;
            lengths.push(long.sqrt());
        }
    }
    let vectors = forward.vectors.iter().zip(&valid);
    let vectors = vectors.map(|(vector, valid)| if *valid { *vector } else { [f32::NAN; 2] }).collect();
    Some(Checked {
        valid: lengths.len() as f64 / count.max(1) as f64,
        length: median(lengths),
        apart: median(aparts),
        field: Field { vectors, valid: Some(valid), ..*forward },
    })
}

/// Bilinear between pixel centres; `None` outside them, and where a vector that counts is not known.
fn between(field: &Field, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let inside = |at: f64, count: usize| at >= 0.0 && at <= count as f64 - 1.0;
    if !inside(x, field.width) || !inside(y, field.height) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    let (along, down) = (x - column as f64, y - row as f64);
    let mut sum = [0.0; 2];
    for (dx, dy, weight) in [
        (0, 0, (1.0 - along) * (1.0 - down)),
        (1, 0, along * (1.0 - down)),
        (0, 1, (1.0 - along) * down),
        (1, 1, along * down),
    ] {
        // On the last column and row the next ones have no weight and need not be there.
        if weight > 0.0 {
            let [u, v] = field.at(column + dx, row + dy)?;
            sum = [sum[0] + weight * f64::from(u), sum[1] + weight * f64::from(v)];
        }
    }
    Some(sum)
}

fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Sorts pairs, which come by name, into scenes. In VBOF's layout a scene is what one camera saw from the same two
/// places, brightest exposure first; elsewhere every pair is a scene of its own.
pub fn scenes(kind: Kind, items: Vec<Item>) -> Vec<Vec<Item>> {
    let mut scenes: Vec<Vec<Item>> = vec![];
    for item in items {
        let same = |scene: &&mut Vec<Item>| kind == Kind::Vbof && scene[0].name.get(..6) == item.name.get(..6);
        match scenes.last_mut().filter(same) {
            Some(scene) => scene.push(item),
            None => scenes.push(vec![item]),
        }
    }
    scenes
}

/// How far a reference is from a truth that happened to be there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Against {
    /// Median end-point error of what is known of the reference, px.
    pub median: f64,
    /// Mean of the same.
    pub mean: f64,
    /// Mean end-point error of the flow there before the check, px.
    pub unchecked: f64,
}

/// Compares a reference, and the flow that it was made of, with a truth; `None` where no pixel is known to both.
pub fn against(reference: &Field, forward: &Field, truth: &Field) -> Option<Against> {
    let (kept, all) = (reference.errors(truth)?, forward.errors(truth)?);
    let finite = |errors: Vec<Option<f32>>| -> Vec<f64> {
        errors.into_iter().flatten().filter(|error| error.is_finite()).map(f64::from).collect()
    };
    let (kept, all) = (finite(kept), finite(all));
    let mean = |errors: &[f64]| errors.iter().sum::<f64>() / errors.len() as f64;
    (!kept.is_empty()).then(|| Against { mean: mean(&kept), unchecked: mean(&all), median: median(kept) })
}

/// One scene's reference, for the table.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The pair that it was made of.
    pub pair: String,
    /// How many pairs it is the reference of.
    pub exposures: usize,
    /// Part of its pixels that is known, 0…1.
    pub valid: f64,
    /// Median length of its known vectors, px.
    pub length: f64,
    /// Median of there and back, px.
    pub apart: f64,
    /// Where a truth was there.
    pub against: Option<Against>,
}

/// The table, with its means over the scenes and what was left out.
pub fn markdown(about: &[(String, String)], rows: &[Row], skipped: &[Skipped]) -> String {
    let mut text = String::new();
    for (what, value) in about {
        let _ = writeln!(text, "- {what}: {value}");
    }
    let known: Vec<Against> = rows.iter().filter_map(|row| row.against).collect();
    let mut titles = vec!["pair", "exposures", "valid, %", "median flow, px", "median there and back, px"];
    if !known.is_empty() {
        titles.extend(["error against the truth, median, px", "mean, px", "mean before the check, px"]);
    }
    let _ = writeln!(text, "\n| {} |\n|{}", titles.join(" | "), " --- |".repeat(titles.len()));
    let error = |against: Option<Against>| match against {
        _ if known.is_empty() => String::new(),
        Some(Against { median, mean, unchecked }) => format!(" {median:.3} | {mean:.3} | {unchecked:.3} |"),
        None => " – | – | – |".into(),
    };
    for Row { pair, exposures, valid, length, apart, against } in rows {
        let _ = write!(text, "| {pair} | {exposures} | {:.1} | {length:.2} | {apart:.3} |", 100.0 * valid);
        let _ = writeln!(text, "{}", error(*against));
    }
    let mean = |of: fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / rows.len() as f64;
    if rows.len() > 1 {
        let all = |of: fn(&Against) -> f64| known.iter().map(of).sum::<f64>() / known.len() as f64;
        let against = Against { median: all(|a| a.median), mean: all(|a| a.mean), unchecked: all(|a| a.unchecked) };
        let pairs = rows.iter().map(|row| row.exposures).sum::<usize>();
        let (valid, length, apart) = (mean(|row| 100.0 * row.valid), mean(|row| row.length), mean(|row| row.apart));
        let _ = write!(text, "| mean of {} | {pairs} | {valid:.1} | {length:.2} | {apart:.3} |", rows.len());
        let _ = writeln!(text, "{}", error(Some(against)));
    }
    text + &datasets::left_out(skipped)
}
