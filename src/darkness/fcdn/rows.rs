//! `fcdn.csv`: what was drawn for every finished pair, added to as pairs are finished and sorted at the end.

use std::{
    collections::BTreeMap,
    fs::{self, File, OpenOptions},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::{Drawn, Error, whole};

const FILE: &str = "fcdn.csv";
/// The table's first line.
pub const TITLE: &str = "pair,level,a_red,a_green,a_blue,b_red,b_green,b_blue,gamma_red,gamma_green,gamma_blue,\
gain_red,gain_green,gain_blue,camera,iso,raw_mean";
const COLUMNS: usize = 17;

/// A pair's line of the table, without its end. Noise in units of white, the level on the 8-bit scale; the last three
/// are empty where no camera was drawn.
pub fn row(name: &str, drawn: &Drawn) -> String {
    let three = |values: [f64; 3], places: usize| values.map(|value| format!("{value:.places$}")).join(",");
    let noise = |values: [f64; 3]| values.map(|value| format!("{value:.6e}")).join(",");
    let taken = drawn.taken.map_or_else(
        || ",,".into(),
        |(profile, mean)| format!("{} {},{},{mean:.6}", profile.maker, profile.model, profile.iso),
    );
    format!(
        "{name},{:.3},{},{},{},{},{taken}",
        drawn.level,
        noise(drawn.a),
        noise(drawn.b),
        three(drawn.gamma, 5),
        three(drawn.gain, 5)
    )
}

/// The table, open at its end.
pub struct Rows {
    path: PathBuf,
    file: File,
    /// By name.
    known: BTreeMap<String, String>,
}

impl Rows {
    /// Reads what there is; a line that was torn off is left out, and its pair has to be made again.
    pub(super) fn open(folder: &Path) -> Result<Self, Error> {
        let path = folder.join(FILE);
        let text = match fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => String::new(),
            Err(error) => return Err(Error::folder(&path)(error)),
        };
        let mut known = BTreeMap::new();
        for line in text.split_inclusive('\n').skip(1) {
            let Some(line) = line.strip_suffix('\n') else { continue };
            if let Some((name, _)) = line.split_once(',').filter(|_| line.split(',').count() == COLUMNS) {
                known.insert(name.to_owned(), line.to_owned());
            }
        }
        write(&path, &known)?;
        let file = OpenOptions::new().append(true).open(&path).map_err(Error::folder(&path))?;
        Ok(Self { path, file, known })
    }

    /// Whether the pair has a row.
    pub fn has(&self, name: &str) -> bool {
        self.known.contains_key(name)
    }

    /// The levels of all rows, 8-bit scale.
    pub fn levels(&self) -> impl Iterator<Item = f64> {
        self.known.values().filter_map(|row| row.split(',').nth(1)?.parse().ok())
    }

    /// Adds a finished pair.
    pub fn add(&mut self, name: &str, drawn: &Drawn) -> Result<(), Error> {
        let row = row(name, drawn);
        self.file.write_all(format!("{row}\n").as_bytes()).map_err(Error::folder(&self.path))?;
        self.known.insert(name.to_owned(), row);
        Ok(())
    }

    /// Writes the table again, in the order of the names.
    pub fn finish(self) -> Result<(), Error> {
        write(&self.path, &self.known)
    }
}

fn write(path: &Path, rows: &BTreeMap<String, String>) -> Result<(), Error> {
    let mut text = format!("{TITLE}\n");
    for row in rows.values() {
        text.push_str(row);
        text.push('\n');
    }
    whole(path, |part| fs::write(part, text))
}
