//! Measured noise of real cameras, by camera and ISO.
//!
//! The figures are those of darktable's noise profiles (`noiseprofiles.json`), read out for the cameras of the paper
//! and some others: variance a·x + b of a raw value x in 0…1, for red, green and blue.
//!
//! **They are milder than the sensors are**, by two to three times in deviation where we could look. A raw of the Canon EOS
//! 30D at ISO 640 (`nightflow noise measure canon30d_iso640.cr2`) has a = 1.39e-4, 1.40e-4 and 1.43e-4 in red, green and blue,
//! each to 6 %, where the profile says 3.0e-5, 1.4e-5 and 2.0e-5, and b = 3e-7 to 8e-7 (its masked columns: 4.7e-7), where the
//! profile says less than 0 in red and green: at the planes' means 2.2, 3.3 and 2.1 times its deviation. darktable's tool
//! (`tools/noise/noiseprofile.c`) does not measure the raw values. It takes the diagonal detail of a Haar transform that
//! halves where it should divide by √2, twice: the deviation comes out half as large (darktable issue 4411). And it does
//! so after demosaicing, where most pixels are means of their neighbours, and after the input colour profile: the finest
//! detail has lost noise to coarser ones (issue 2313, which finds variances of 10 to 15 where the profiles promise 1).
//! White noise that is demosaiced bilinearly loses another factor of 2.3 in deviation in green and of 4 in red and blue;
//! the demosaicing that darktable uses, less. darktable's own denoising is tuned to these figures, so they stayed.
//!
//! We keep the figures as they are, as the range of cameras and ISOs relative to one another, and because the paper's
//! noise levels follow from such figures. Who wants a real sensor measures it.

use super::noise::Noise;

const TABLE: &str = include_str!("noise_profiles.csv");

/// A line of the table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    /// As in `Canon`.
    pub maker: &'static str,
    /// As in `EOS M6`.
    pub model: &'static str,
    /// Sensitivity.
    pub iso: u32,
    /// Its noise, with b clamped to 0: see [`find`].
    pub noise: Noise,
}

/// Why there is no profile.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Not in the table.
    #[error("no noise profile of a camera {camera:?}; there are {known}")]
    Camera {
        /// As asked for.
        camera: String,
        /// What there is.
        known: String,
    },
    /// The camera was not measured at this ISO.
    #[error("no noise profile of {camera} at ISO {iso}; there are {known}")]
    Iso {
        /// As asked for.
        camera: String,
        /// As asked for.
        iso: u32,
        /// What there is.
        known: String,
    },
}

/// Every profile of the table, in its order.
pub fn all() -> impl Iterator<Item = Profile> {
    TABLE.lines().skip(1).filter_map(read)
}

fn read(line: &'static str) -> Option<Profile> {
    let mut fields = line.split(',');
    let (maker, model, iso) = (fields.next()?, fields.next()?, fields.next()?.parse().ok()?);
    let mut figures = [0.0; 6];
    for figure in &mut figures {
        *figure = fields.next()?.trim().parse().ok()?;
    }
    let [ar, ag, ab, br, bg, bb] = figures;
    Some(Profile { maker, model, iso, noise: Noise { a: [ar, ag, ab], b: [br, bg, bb].map(|b: f64| b.max(0.0)) } })
}

/// The noise of a camera (`Canon EOS M6`, case does not matter) at an ISO that it was measured at.
///
/// A negative b is clamped to 0. It comes from older cameras (the Canon EOS 30D among them): b is where a straight line
/// through the measured variances meets black, and where the read noise is small beside the line's own error, or was
/// cut off at the black level, the line ends below zero. No variance is negative, and a·y alone is then the honest rest.
pub fn find(camera: &str, iso: u32) -> Result<Noise, Error> {
    let is = |profile: &Profile| format!("{} {}", profile.maker, profile.model).eq_ignore_ascii_case(camera.trim());
    if !all().any(|profile| is(&profile)) {
        let mut known: Vec<String> = all().map(|profile| format!("{} {}", profile.maker, profile.model)).collect();
        known.dedup();
        return Err(Error::Camera { camera: camera.into(), known: known.join(", ") });
    }
    let found = all().find(|profile| is(profile) && profile.iso == iso);
    found.map(|profile| profile.noise).ok_or_else(|| {
        let known: Vec<String> = all().filter(is).map(|profile| profile.iso.to_string()).collect();
        Error::Iso { camera: camera.into(), iso, known: known.join(", ") }
    })
}
