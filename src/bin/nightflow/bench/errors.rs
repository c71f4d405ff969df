//! End-point errors of networks and methods, out of a table that `nightflow eval ladder --out` wrote.

use std::path::Path;

use anyhow::{Context, Result};

use super::Mistake;

/// The exposures that are shown: by day, and in the dark.
pub const CONDITIONS: [&str; 2] = ["Exp-0", "Exp-4"];

/// Mean end-point errors, px, by method and condition.
pub struct Errors(Vec<(String, String, f64)>);

impl Errors {
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
        let wrong = |what: String| {
            Mistake(format!("{}: {what}; expected table.csv of nightflow eval ladder --out", path.display()))
        };
        let mut lines = text.lines();
        let names = fields(lines.next().unwrap_or_default());
        let column = |name: &str| {
            names.iter().position(|found| found == name).ok_or_else(|| wrong(format!("it has no column {name:?}")))
        };
        let [condition, method, epe] = [column("condition")?, column("method")?, column("epe")?];
        let fault = names.iter().position(|found| found == "fault");
        let mut errors = vec![];
        for (number, line) in lines.enumerate() {
            let fields = fields(line);
            let of = |at: usize| fields.get(at).map(String::as_str).unwrap_or_default();
            // Noise beside the camera's is another story.
            if fault.is_some_and(|at| of(at) != "none") {
                continue;
            }
            let value = of(epe).parse().map_err(|_| wrong(format!("line {} has no number for epe", number + 2)))?;
            errors.push((of(method).to_owned(), of(condition).to_owned(), value));
        }
        Ok(Self(errors))
    }

    /// The errors of a method at [`CONDITIONS`].
    pub fn of(&self, method: &str) -> [Option<f64>; 2] {
        CONDITIONS
            .map(|condition| self.0.iter().find(|(m, c, _)| m == method && c == condition).map(|(_, _, epe)| *epe))
    }
}

/// A line of CSV; what is quoted may have commas, and quotes twice.
fn fields(line: &str) -> Vec<String> {
    let (mut fields, mut field, mut quoted) = (vec![], String::new(), false);
    let mut letters = line.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '"' if quoted && letters.peek() == Some(&'"') => field.extend(letters.next()),
            '"' => quoted = !quoted,
            ',' if !quoted => fields.push(std::mem::take(&mut field)),
            letter => field.push(letter),
        }
    }
    fields.push(field);
    fields
}
