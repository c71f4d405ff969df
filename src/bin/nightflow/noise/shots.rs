//! Frames out of raw photographs, recordings and plain dumps.

use std::{path::Path, time::Duration};

use anyhow::{Context, Result, bail};
use nightflow::{
    camera::{Next, Sample, Source, mcap::Recording},
    clock::Stamp,
    config::Config,
    exposure::{self, Mosaic},
    recording,
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
    let known = recording::metadata(path, "nightflow")?;
    let mut config = match (&args.config, known.as_ref().and_then(|known| known.get("config"))) {
        (Some(file), _) => launch::read(Some(file))?,
        (None, Some(text)) => Config::parse(text, Path::new(&format!("in {}", path.display())))?,
        (None, None) => Config::default(),
    };
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

#[cfg(not(feature = "raw"))]
fn photograph(path: &Path) -> Result<Shot> {
    bail!(
        "{} is taken for a camera raw file, and this build can't read those: rebuild with \
         `cargo build --release --features raw` (rawler, which reads them, is LGPL-2.1). \
         Recordings end in .mcap, plain dumps of counts in .raw, .bin or .u16",
        path.display()
    )
}

/// The photograph's active area, with its camera and sensitivity.
#[cfg(feature = "raw")]
fn photograph(path: &Path) -> Result<Shot> {
    use nightflow::exposure::Pattern;
    use rawler::{
        decoders::RawDecodeParams,
        rawimage::{RawImageData, RawPhotometricInterpretation::Cfa},
        rawsource::RawSource,
    };
    let shown = path.display().to_string();
    let source = RawSource::new(path).with_context(|| shown.clone())?;
    let (decoder, params) = (rawler::get_decoder(&source)?, RawDecodeParams::default());
    let raw = decoder.raw_image(&source, &params, false).with_context(|| shown.clone())?;
    let exif = decoder.raw_metadata(&source, &params).map(|known| known.exif).ok();
    // Some writers leave a 0 where they know none.
    let iso = exif.and_then(|exif| exif.iso_speed.or(exif.iso_speed_ratings.map(u32::from))).filter(|iso| *iso > 0);
    let (RawImageData::Integer(all), Cfa(mosaic)) = (&raw.data, &raw.photometric) else {
        bail!("{shown}: expected integer counts of a Bayer mosaic")
    };
    let (left, top, width, height) = match raw.active_area {
        Some(area) => (area.p.x, area.p.y, area.d.w, area.d.h),
        None => (0, 0, raw.width, raw.height),
    };
    let colours: Vec<usize> = (0..4).map(|place| mosaic.cfa.color_at(top + place / 2, left + place % 2)).collect();
    let pattern = match colours[..] {
        [0, 1, 1, 2] => Pattern::Rggb,
        [2, 1, 1, 0] => Pattern::Bggr,
        [1, 2, 0, 1] => Pattern::Gbrg,
        [1, 0, 2, 1] => Pattern::Grbg,
        _ => bail!("{shown}: expected a Bayer mosaic, found {}", mosaic.cfa.name),
    };
    if (mosaic.cfa.width, mosaic.cfa.height) != (2, 2) {
        bail!("{shown}: expected a Bayer mosaic of 2×2, found one of {}×{}", mosaic.cfa.width, mosaic.cfa.height);
    }
    let rows = (top..top + height).map(|row| row * raw.width + left);
    let counts = rows.flat_map(|begin| all[begin..begin + width].iter().copied()).collect();
    // rawler gives levels from the sensor's own corner, which the active area need not share.
    let levels = raw.blacklevel.as_bayer_array();
    let black = std::array::from_fn(|place| levels[(top + place / 2) % 2 * 2 + (left + place % 2) % 2]);
    let white = raw.whitelevel.as_bayer_array()[0];
    let camera = Some(format!("{} {}", raw.clean_make, raw.clean_model));
    Ok(Shot {
        name: name(path),
        camera,
        iso,
        mosaic: Mosaic { width, height, counts, pattern: Some(pattern), black, white },
    })
}
