//! The effective configuration: one section a stage, read from a file that holds only what differs.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::{
    camera, exposure, flow, motion,
    publish::{
        self,
        autopilot::{Word, px4::Topic},
    },
    recording,
};

/// Everything that can be set. `nightflow config` prints the effective whole with the reason of every value.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Where samples come from.
    pub camera: camera::Config,
    /// How raw counts are read and scaled.
    pub exposure: exposure::Config,
    /// Which network, and when its flow is trusted.
    pub flow: flow::Config,
    /// The vehicle's geometry and the fit.
    pub motion: motion::Config,
    /// Where results go.
    pub publish: publish::Config,
    /// What is kept.
    pub recording: recording::Config,
}

/// Why a configuration can't be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file can't be read.
    #[error("configuration {path} can't be read: {reason}", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: std::io::Error,
    },
    /// The file is no configuration; the reason names the line and what would be right.
    #[error("configuration {path}: {reason}{hint}", path = path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What the parser said.
        reason: String,
        /// The nearest name that exists, if one is near.
        hint: String,
    },
    /// An autopilot is to be told of what nobody looks for.
    #[error(
        "configuration {path}: {key} names {word}, and nobody looks for obstacles: add a table [motion.obstacles]",
        path = path.display()
    )]
    NoLookout {
        /// The file.
        path: PathBuf,
        /// The setting.
        key: &'static str,
        /// What it names.
        word: &'static str,
    },
    /// An EKF is to be told the accelerometer's word twice.
    #[error(
        "configuration {path}: publish.mavlink.words names odometry, whose velocity PX4's EKF weighs with the accelerometer itself, \
         and with motion.inertia = true that has been done already: set inertia = false in [motion]",
        path = path.display()
    )]
    ToldTwice {
        /// The file.
        path: PathBuf,
    },
    /// The settings can't be written as TOML.
    #[error("the configuration can't be written: {0}")]
    Unwritable(#[from] toml::ser::Error),
}

impl Config {
    /// Reads a launch file.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let text = std::fs::read_to_string(path).map_err(|reason| Error::Unreadable { path: path.into(), reason })?;
        Self::parse(&text, path)
    }

    /// Reads the text of a launch file; `path` is for messages only.
    pub fn parse(text: &str, path: &Path) -> Result<Self, Error> {
        let config: Self = toml::from_str(text).map_err(|error| {
            let reason = error.to_string();
            let hint = nearest(&reason).map(|name| format!("did you mean `{name}`?")).unwrap_or_default();
            Error::Invalid { path: path.into(), reason, hint }
        })?;
        if let Some((key, word)) = config.unlooked() {
            return Err(Error::NoLookout { path: path.into(), key, word });
        }
        let fused = config.publish.mavlink.as_ref().is_some_and(|mavlink| mavlink.words.contains(&Word::Odometry));
        if fused && config.motion.inertia {
            return Err(Error::ToldTwice { path: path.into() });
        }
        Ok(config)
    }

    /// What asks for obstacles though nobody looks for them: the setting, and what it names.
    fn unlooked(&self) -> Option<(&'static str, &'static str)> {
        let publish::Config { mavlink, px4, .. } = &self.publish;
        if self.motion.obstacles.is_some() {
            return None;
        }
        if mavlink.as_ref().is_some_and(|mavlink| mavlink.words.contains(&Word::Obstacles)) {
            return Some(("publish.mavlink.words", "obstacles"));
        }
        let px4 = px4.as_ref().is_some_and(|px4| px4.topics.contains(&Topic::ObstacleDistance));
        px4.then_some(("publish.px4.topics", "obstacle_distance"))
    }

    /// The whole configuration as TOML that reads back to the same.
    pub fn to_toml(&self) -> Result<String, Error> {
        Ok(toml::to_string(self)?)
    }

    /// The whole configuration as TOML, with the reason of every value behind it.
    pub fn explained(&self) -> Result<String, Error> {
        let mut out = String::new();
        let mut section = String::new();
        for line in self.to_toml()?.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
                section = name.to_owned();
            }
            let key = line.split_once(" = ").map(|(key, _)| format!("{section}.{key}"));
            match key.as_deref().and_then(reason) {
                Some(why) => out.push_str(&format!("{line:<44} # {why}\n")),
                None => out.push_str(&format!("{line}\n")),
            }
        }
        Ok(out)
    }
}

/// The reasons of all stages, with the section that they belong to.
const REASONS: &[(&str, &[(&str, &str)])] = &[
    ("camera", camera::REASONS),
    ("exposure", exposure::REASONS),
    ("flow", flow::REASONS),
    ("motion", motion::REASONS),
    ("motion", motion::obstacles::REASONS),
    ("publish", publish::REASONS),
    ("recording", recording::REASONS),
];

/// Why the value of `camera.image_topic` (say) is what it is.
pub fn reason(key: &str) -> Option<&'static str> {
    let (section, rest) = key.split_once('.')?;
    let all = REASONS.iter().filter(|(name, _)| *name == section).flat_map(|(_, reasons)| *reasons);
    all.into_iter().find(|(name, _)| *name == rest).map(|(_, why)| *why)
}

/// Of the names that the parser expected, the one nearest to the one that it found.
fn nearest(reason: &str) -> Option<&str> {
    let (_, after) = reason.split_once("unknown field `").or_else(|| reason.split_once("unknown variant `"))?;
    let (found, expected) = after.split_once('`')?;
    expected
        .split('`')
        .skip(1)
        .step_by(2)
        .map(|name| (distance(found, name), name))
        .min()
        .filter(|(away, name)| *away * 2 <= name.len().max(2))
        .map(|(_, name)| name)
}

/// Levenshtein's distance.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, to) in b.iter().enumerate() {
            let changed = diagonal + usize::from(from != *to);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_reads_back_to_itself() {
        let text = Config::default().to_toml().unwrap();
        assert_eq!(Config::parse(&text, Path::new("default")).unwrap(), Config::default());
    }

    #[test]
    fn every_value_has_its_reason() {
        let text = Config::default().explained().unwrap();
        let bare: Vec<&str> = text.lines().filter(|line| line.contains(" = ") && !line.contains(" # ")).collect();
        assert!(bare.is_empty(), "no reason is given for:\n{}", bare.join("\n"));
    }

    #[test]
    fn what_tells_of_obstacles_needs_somebody_who_looks_for_them() {
        for (lines, key) in [
            ("[publish.mavlink]\nwords = [\"flow\", \"obstacles\"]\n", "publish.mavlink.words names obstacles"),
            ("[publish.px4]\ntopics = [\"obstacle_distance\"]\n", "publish.px4.topics names obstacle_distance"),
        ] {
            let error = Config::parse(lines, Path::new("ahead.toml")).unwrap_err().to_string();
            assert!(error.contains("ahead.toml") && error.contains(key), "{error}");
            assert!(error.contains("[motion.obstacles]"), "{error}");
            Config::parse(&format!("{lines}[motion.obstacles]\n"), Path::new("ahead.toml")).unwrap();
        }
    }

    #[test]
    fn a_wrong_name_is_answered_with_the_right_one() {
        let error = Config::parse("[exposure]\nmean_traget = 0.3\n", Path::new("night.toml")).unwrap_err().to_string();
        assert!(error.contains("night.toml") && error.contains("did you mean `mean_target`?"), "{error}");
        assert!(error.contains("mean_traget") && error.contains("line 2"), "{error}");
    }
}
