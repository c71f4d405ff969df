//! What was measured, as a table, as CSV and as JSON.

use std::fmt::Write;

use nightflow::darkness::{foi::Fit, noise::Noise};
use serde_json::{Value, json};

/// One colour of a frame.
pub struct Colour {
    pub name: &'static str,
    pub fit: Fit,
}

/// One frame.
pub struct Measured {
    pub name: String,
    /// And its ISO; empty where it is not known.
    pub camera: String,
    pub size: [usize; 2],
    pub black: f32,
    pub white: f32,
    /// Of the three colours above black, 1 = white.
    pub mean: f64,
    /// Noise level in 1/255 once the mean is 0.4.
    pub level: f64,
    pub colours: Vec<Colour>,
    /// darktable's figures.
    pub profile: Option<Noise>,
}

impl Colour {
    /// Signal to noise at the plane's mean, decibels.
    fn snr_db(&self) -> f64 {
        20.0 * (self.fit.mean.max(0.0) / self.fit.variance(self.fit.mean).sqrt()).log10()
    }

    fn profiled(&self, profile: &Noise) -> [f64; 2] {
        let colour = match self.name {
            "R" => 0,
            "B" => 2,
            _ => 1,
        };
        [profile.a[colour], profile.b[colour]]
    }
}

/// For the eye.
pub fn table(all: &[Measured]) -> String {
    let mut text = String::new();
    for shot in all {
        let camera = if shot.camera.is_empty() { String::new() } else { format!("{}, ", shot.camera) };
        let [width, height] = shot.size;
        let _ = writeln!(text, "{} ({camera}{width}×{height}, black {}, white {})", shot.name, shot.black, shot.white);
        let _ = writeln!(text, "  noise level {:.1}/255 at a mean of 0.4; raw mean {:.5}", shot.level, shot.mean);
        let _ = writeln!(
            text,
            "  {:<5} {:>10}  {:<23} {:>10}  {:<23} {:>7} {:>8} {:>7}",
            "plane", "a", "bounds of a", "b", "bounds of b", "misfit", "mean", "SNR dB"
        );
        for colour in &shot.colours {
            let fit = &colour.fit;
            let bounds = |[low, high]: [f64; 2]| format!("{low:.2e} … {high:.2e}");
            let _ = writeln!(
                text,
                "  {:<5} {:>10.3e}  {:<23} {:>10.3e}  {:<23} {:>7.2} {:>8.5} {:>7.1}",
                colour.name,
                fit.a,
                bounds(fit.a_bounds()),
                fit.b,
                bounds(fit.b_bounds()),
                fit.misfit,
                fit.mean,
                colour.snr_db()
            );
            if let Some(profile) = &shot.profile {
                let [a, b] = colour.profiled(profile);
                let _ = writeln!(
                    text,
                    "        {a:>10.3e}  {:<23} {b:>10.3e}  {:.1} times in deviation",
                    "by darktable's profile",
                    (fit.variance(fit.mean) / (a * fit.mean + b)).sqrt()
                );
            }
        }
    }
    text
}

/// A line a plane.
pub fn csv(all: &[Measured]) -> String {
    let mut text = String::from(
        "file,camera,plane,a,a_low,a_high,b,b_low,b_high,misfit,mean,snr_db,raw_mean,noise_level_255,profile_a,profile_b\n",
    );
    let quoted = |text: &str| format!("\"{}\"", text.replace('"', "\"\""));
    for shot in all {
        for colour in &shot.colours {
            let fit = &colour.fit;
            let ([a_low, a_high], [b_low, b_high]) = (fit.a_bounds(), fit.b_bounds());
            let profile = shot.profile.as_ref().map(|profile| colour.profiled(profile));
            let _ = write!(text, "{},{},{}", quoted(&shot.name), quoted(&shot.camera), colour.name);
            for figure in [fit.a, a_low, a_high, fit.b, b_low, b_high] {
                let _ = write!(text, ",{figure:.6e}");
            }
            let _ = write!(text, ",{:.3},{:.6},{:.3}", fit.misfit, fit.mean, colour.snr_db());
            let _ = write!(text, ",{:.6},{:.4}", shot.mean, shot.level);
            let _ = match profile {
                Some([a, b]) => writeln!(text, ",{a:.6e},{b:.6e}"),
                None => writeln!(text, ",,"),
            };
        }
    }
    text
}

/// Everything, the level sets too.
pub fn json(all: &[Measured]) -> Value {
    let plane = |shot: &Measured, colour: &Colour| {
        let fit = &colour.fit;
        let levels = fit.levels.iter().map(|l| json!({"mean": l.mean, "deviation": l.deviation, "count": l.count}));
        json!({
            "plane": colour.name,
            "a": fit.a,
            "a_bounds": fit.a_bounds(),
            "b": fit.b,
            "b_bounds": fit.b_bounds(),
            "covariance": [[fit.a_sd.powi(2), fit.ab], [fit.ab, fit.b_sd.powi(2)]],
            "misfit": fit.misfit,
            "mean": fit.mean,
            "snr_db": colour.snr_db(),
            "profile": shot.profile.as_ref().map(|profile| colour.profiled(profile)),
            "levels": levels.collect::<Vec<_>>(),
        })
    };
    let shot = |shot: &Measured| {
        json!({
            "file": shot.name,
            "camera": shot.camera,
            "size": shot.size,
            "black": shot.black,
            "white": shot.white,
            "raw_mean": shot.mean,
            "noise_level_255": shot.level,
            "planes": shot.colours.iter().map(|colour| plane(shot, colour)).collect::<Vec<_>>(),
        })
    };
    Value::Array(all.iter().map(shot).collect())
}
