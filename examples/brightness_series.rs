//! A brightness series as VBOF's, out of a recorded pan: real raws as the bright exposure, the same ever darker, and the pan.
//!
//! `cargo run --release --example brightness_series -- --out series` writes `series/vbof`, frames as VBOF publishes its
//! own (linear, mean 0.4) with names as CCPPQQEE_img1.png, and `series/bright`, the bright pairs as sRGB pictures. The
//! known pan lies beside them as `_flow.flo`. `nightflow eval reference series/vbof --out judged` makes references without
//! looking at it and says how far off they are.
//!
//! Exposure 01 is the raw as it was shot, with the noise that it has. Exposures 02 to 06 are the same attenuated to the raw
//! means of the ladder's Exp-2 to Exp-6, with the photons and the read noise of a Canon EOS M6 at ISO 3200 on top.

use std::{
    collections::BTreeMap,
    error::Error,
    fs,
    path::{Path, PathBuf},
};

use clap::Parser;
use nightflow::{
    clock::Stamp,
    config::Config,
    darkness::{
        flow_files::{self, Field},
        ladder::{Linear, MEANS, Sensor},
        picture::Picture,
        raws::{self, Mosaic},
    },
    recording,
    wire::{self, Image, Vector3Stamped},
};

/// The ladder's rungs that are darker than the recording itself.
const DARKER: std::ops::Range<usize> = 2..MEANS.len();
/// Part of the light that is white in the sRGB pictures; what is brighter, a hundredth, is cut off there.
const WHITE: f64 = 0.99;

/// Make a brightness series out of a recording of Bayer frames with /truth/pan.
#[derive(Parser)]
struct Args {
    /// The recording.
    #[arg(default_value = "recordings/real_raw_pan.mcap")]
    recording: PathBuf,
    /// The folder to write.
    #[arg(long)]
    out: PathBuf,
    /// How many frames, from the first on: those of real_raw_pan.mcap are as shot up to the thirtieth.
    #[arg(long, default_value_t = 30)]
    frames: usize,
}

fn main() -> Result<(), Box<dyn Error>> {
    let Args { recording, out, frames } = Args::parse();
    write(&recording, &out, frames)
}

/// Writes the series of the recording's first frames.
pub fn write(recording: &Path, out: &Path, frames: usize) -> Result<(), Box<dyn Error>> {
    let (mosaics, pans) = read(recording, frames)?;
    let [vbof, bright] = ["vbof", "bright"].map(|name| out.join(name));
    fs::create_dir_all(&vbof)?;
    fs::create_dir_all(&bright)?;
    let sensor = Sensor::find("Canon EOS M6", 3200)?;
    for (at, (pair, pan)) in mosaics.windows(2).zip(&pans[1..]).enumerate() {
        let (width, height) = (pair[0].width / 2, pair[0].height / 2);
        // A cell of the mosaic becomes a pixel.
        let vector = pan.ok_or("a frame has no pan")?.map(|side| (side / 2.0) as f32);
        let truth = Field { width, height, vectors: vec![vector; width * height], valid: None };
        let scene = format!("01{at:02}{:02}", at + 1);
        save(&vbof, &format!("{scene}01"), &raws::scaled([&pair[0], &pair[1]], (width, height))?)?;
        flow_files::write(&vbof.join(format!("{scene}01_flow.flo")), &truth)?;
        let pictures = developed([&pair[0], &pair[1]])?;
        let linear = Linear::of([&pictures[0], &pictures[1]]);
        for (darker, rung) in DARKER.enumerate() {
            let name = format!("{scene}{:02}", darker + 2);
            save(&vbof, &name, &linear.expose(&sensor, MEANS[rung], 1, &name).pictures())?;
        }
        save(&bright, &format!("pan{at:02}"), &pictures)?;
        flow_files::write(&bright.join(format!("pan{at:02}_flow.flo")), &truth)?;
    }
    println!("{} scenes in {} and {}", mosaics.len().saturating_sub(1), vbof.display(), bright.display());
    Ok(())
}

/// The first frames, and the pan from the frame before that each is known to have.
type Seen = (Vec<Mosaic>, Vec<Option<[f64; 2]>>);

fn read(recording: &Path, frames: usize) -> Result<Seen, Box<dyn Error>> {
    let known = recording::metadata(recording, "nightflow")?;
    let config = known.and_then(|known| known.get("config").cloned()).ok_or("the recording holds no settings")?;
    let levels = Config::parse(&config, recording)?.exposure;
    let (black, white) =
        levels.black_level.zip(levels.white_level).ok_or("the settings lack the black or white level")?;
    let bytes = fs::read(recording)?;
    let (mut images, mut pans) = (BTreeMap::new(), BTreeMap::new());
    for message in mcap::MessageStream::new(&bytes)? {
        let message = message?;
        match message.channel.topic.as_str() {
            "/camera/image_raw" if images.len() < frames => {
                let image: Image = wire::decode(&message.data)?;
                images.insert(Stamp::from(image.header.stamp), image);
            }
            "/truth/pan" => {
                let pan: Vector3Stamped = wire::decode(&message.data)?;
                pans.insert(Stamp::from(pan.header.stamp), [pan.vector.x, pan.vector.y]);
            }
            _ => {}
        }
    }
    let seen = images.into_iter().map(|(stamp, image)| {
        let (width, height, encoding) = (image.width as usize, image.height as usize, image.encoding);
        if encoding != "bayer_rggb16" || image.is_bigendian != 0 || image.data.len() != 2 * width * height {
            return Err(format!("expected little-endian bayer_rggb16 without gaps, found {encoding}"));
        }
        let counts = image.data.as_chunks::<2>().0.iter().map(|count| u16::from_le_bytes(*count)).collect();
        let (black, white) = (f64::from(black), f64::from(white));
        let mosaic = Mosaic { width, height, counts, black, white, period: 2, colours: vec![0, 1, 1, 2] };
        Ok((mosaic, pans.get(&stamp).copied()))
    });
    Ok(seen.collect::<Result<Vec<_>, String>>()?.into_iter().unzip())
}

/// Both frames as sRGB pictures under one gain.
fn developed(mosaics: [&Mosaic; 2]) -> Result<[Picture; 2], raws::Error> {
    let frames = [mosaics[0].binned()?, mosaics[1].binned()?];
    let mut lights: Vec<f32> = frames.iter().flat_map(|frame| frame.rgb.iter().copied()).collect();
    let at = (lights.len() as f64 * WHITE) as usize;
    let white = lights.select_nth_unstable_by(at, f32::total_cmp).1.max(1e-6);
    Ok(frames.map(|frame| {
        let values: Vec<f32> = frame.rgb.iter().map(|light| curve(light / white)).collect();
        Picture::from_unit(frame.width, frame.height, &values)
    }))
}

/// The sRGB curve (IEC 61966-2-1).
fn curve(light: f32) -> f32 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

fn save(folder: &Path, name: &str, frames: &[Picture; 2]) -> Result<(), Box<dyn Error>> {
    for (frame, role) in frames.iter().zip(["img1", "img2"]) {
        frame.write(&folder.join(format!("{name}_{role}.png")))?;
    }
    Ok(())
}
