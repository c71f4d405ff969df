//! Frames out of raw photographs, recordings and plain dumps.

use std::{path::Path, time::Duration};

use anyhow::{Context, Result, bail};
use nightflow::{
    camera::{Next, Sample, Source, mcap::Recording},
    clock::Stamp,
    darkness::photographs::{self, RawPhotograph},
    exposure::{self, Mosaic, Pattern},
};

use super::{Measure, Shot, ending};
use crate::launch;

/// The frames of one path, one after the other.
pub enum Shots {
    /// A photograph or a dump.
    One(Option<Box<Shot>>),
    /// A recording.
    Many(Box<Frames>),
}

/// The frames of a recording that are far enough apart.
pub struct Frames {
    name: String,
    recording: Recording,
    exposure: exposure::Config,
    every_s: f64,
    first: Option<Stamp>,
    newest: Option<Stamp>,
}

impl Shots {
    /// Sees by its name what a file is.
    pub fn open(path: &Path, args: &Measure) -> Result<Self> {
        if !path.exists() {
            let missing = std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such file or folder");
            return Err(missing).with_context(|| path.display().to_string());
        }
        let mut shot = match ending(path).as_str() {
            "mcap" => return Ok(Self::Many(Box::new(frames(path, args)?))),
            _ if path.is_dir() => return Ok(Self::Many(Box::new(frames(path, args)?))),
            "raw" | "bin" | "u16" => dump(path, args)?,
            _ => photograph(path)?,
        };
        if let Some(black) = args.black {
            shot.mosaic.black = [black; 4];
        }
        shot.mosaic.white = args.white.unwrap_or(shot.mosaic.white);
        let black = shot.mosaic.black.iter().fold(0.0_f32, |most, black| most.max(*black));
        if black >= shot.mosaic.white {
            bail!("{}: black {black} is not below white {}", path.display(), shot.mosaic.white);
        }
        Ok(Self::One(Some(Box::new(shot))))
    }
}

impl Iterator for Shots {
    type Item = Result<Shot>;

    fn next(&mut self) -> Option<Self::Item> {
        match self {
            Self::One(shot) => shot.take().map(|shot| Ok(*shot)),
            Self::Many(frames) => frames.next().transpose(),
        }
    }
}

impl Frames {
    fn next(&mut self) -> Result<Option<Shot>> {
        loop {
            let frame = match self.recording.next(Duration::ZERO)? {
                Next::Sample(Sample::Frame(frame)) => frame,
                Next::End if self.first.is_none() => {
                    bail!("{}: expected frames on the image topic, found none; --config names another", self.name)
                }
                Next::End => return Ok(None),
                _ => continue,
            };
            let stamp = frame.stamp();
            // Half a millisecond of slack, as stamps are rounded.
            if self.newest.is_some_and(|newest| stamp.seconds_since(newest) < self.every_s - 5e-4) {
                continue;
            }
            self.newest = Some(stamp);
            let first = *self.first.get_or_insert(stamp);
            let name = format!("{} at {:.2} s", self.name, stamp.seconds_since(first));
            let mosaic = Mosaic::read(&self.exposure, &frame.image).with_context(|| name.clone())?;
            return Ok(Some(Shot { name, camera: None, iso: None, mosaic }));
        }
    }
}

fn frames(path: &Path, args: &Measure) -> Result<Frames> {
    let mut config = launch::settings(args.config.as_deref(), path)?;
    config.exposure.black_level = args.black.or(config.exposure.black_level);
    config.exposure.white_level = args.white.or(config.exposure.white_level);
    if let Some(colours) = args.pattern {
        config.exposure.pattern = colours.0;
    }
    Ok(Frames {
        name: name(path),
        recording: Recording::open(path, &config.camera)?,
        exposure: config.exposure,
        every_s: args.every_s,
        first: None,
        newest: None,
    })
}

fn name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}

fn dump(path: &Path, args: &Measure) -> Result<Shot> {
    let shown = path.display();
    let (Some([width, height]), Some(colours), Some(_), Some(_)) = (args.size, args.pattern, args.black, args.white)
    else {
        bail!(
            "{shown} is taken for a plain dump of 16-bit counts, which says nothing of itself: \
             expected --size, --pattern, --black and --white"
        );
    };
    let bytes = std::fs::read(path).with_context(|| shown.to_string())?;
    if bytes.len() != 2 * width * height {
        bail!("{shown}: {width}x{height} counts of 16 bits are {} bytes, found {}", 2 * width * height, bytes.len());
    }
    let counts = bytes.as_chunks::<2>().0.iter().map(|pair| u16::from_le_bytes(*pair)).collect();
    let mosaic = Mosaic { width, height, counts, pattern: colours.0, black: [0.0; 4], white: f32::from(u16::MAX) };
    Ok(Shot { name: name(path), camera: None, iso: None, mosaic })
}

/// The photograph's active area, with its camera and sensitivity.
fn photograph(path: &Path) -> Result<Shot> {
    let RawPhotograph { width, height, counts, black, white, colours, camera, iso, .. } = photographs::read(path)
        .context("recordings end in .mcap, plain dumps of counts in .raw, .bin or .u16; all else is a camera's file")?;
    let pattern = match colours[..] {
        [0, 1, 1, 2] => Pattern::Rggb,
        [2, 1, 1, 0] => Pattern::Bggr,
        [1, 2, 0, 1] => Pattern::Gbrg,
        [1, 0, 2, 1] => Pattern::Grbg,
        _ => bail!("{}: expected a Bayer mosaic, found a pattern of {} pixels", path.display(), colours.len()),
    };
    let mosaic = Mosaic { width, height, counts, pattern: Some(pattern), black, white };
    Ok(Shot { name: name(path), camera: Some(camera), iso, mosaic })
}
