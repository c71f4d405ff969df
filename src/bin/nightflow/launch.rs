//! What run, record and replay have in common: opening what the configuration names, and stopping.

use std::{
    collections::BTreeMap,
    path::Path,
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use nightflow::{
    camera,
    config::Config,
    flow::Matcher,
    node::{self, Governor, Outputs, Report},
    pipeline::Pipeline,
    publish::{self, iceoryx2::SharedSink},
    recording::{self, Recorder},
};
use signal_hook::consts::{SIGINT, SIGTERM};

/// The configuration of a launch file, or the default where none is given.
pub fn read(path: Option<&Path>) -> Result<Config> {
    Ok(path.map(Config::read).transpose()?.unwrap_or_default())
}

/// The launch file's settings; or else those that the recording was made with, but for its sinks.
pub fn settings(launch_file: Option<&Path>, bag: &Path) -> Result<Config> {
    if launch_file.is_some() {
        return read(launch_file);
    }
    if !bag.exists() {
        let missing = std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such file or folder");
        return Err(missing).with_context(|| bag.display().to_string());
    }
    let known = recording::metadata(bag, "nightflow")?;
    let mut config = match known.as_ref().and_then(|known| known.get("config")) {
        Some(text) => Config::parse(text, Path::new(&format!("in {}", bag.display())))?,
        None => Config::default(),
    };
    let publish = &mut config.publish;
    (publish.iceoryx2, publish.ros2, publish.zenoh) = (None, None, None);
    (publish.mavlink, publish.px4) = (None, None);
    Ok(config)
}

/// Runs the node from its source to its outputs, with a bar for a finite source and a line for a live one.
pub fn drive(
    config: &Config,
    pipeline: Option<&mut Pipeline>,
    outputs: &mut Outputs<'_>,
    stop: &AtomicBool,
    finite: bool,
) -> Result<Report> {
    let bar = progress(finite)?;
    // A source that waits for us has no rate to keep, and its recording says how wide images were.
    let governor = (!config.camera.waits()).then(|| Governor::new(&config.exposure)).flatten();
    let report = node::drive(
        &mut || camera::open(&config.camera),
        pipeline,
        outputs,
        stop,
        (Duration::from_secs_f64(config.camera.silence_s_max), governor),
        &mut |report, progress| advance(&bar, report, progress),
    );
    bar.finish_and_clear();
    Ok(report?)
}

/// A flag that the first interrupt sets; the second ends the program at once.
pub fn stop() -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        // The order matters: the check for the second signal must be there before the flag is set by the first.
        signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&flag))?;
        signal_hook::flag::register(signal, Arc::clone(&flag))?;
    }
    Ok(flag)
}

/// What a recording says about how it was made; a replay takes its settings from it.
pub fn provenance(config: &Config, network: Option<&Matcher>) -> Result<BTreeMap<String, String>> {
    let mut known = BTreeMap::from([
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("config".to_owned(), config.to_toml()?),
    ]);
    if let Some(network) = network {
        let model = network.model();
        known.insert("model".to_owned(), format!("{} {}", model.name, model.version));
        let files: Vec<String> = model.sha256.iter().map(|(file, hash)| format!("{file} {hash}")).collect();
        known.insert("model_sha256".to_owned(), files.join(", "));
        known.insert("operators".to_owned(), model.operators.to_string());
        known.insert("provider".to_owned(), model.provider.clone());
    }
    Ok(known)
}

/// Opens every sink that the configuration names.
pub fn outputs(config: &Config, network: Option<&Matcher>) -> Result<Outputs<'static>> {
    let mut outputs = Outputs::default();
    if let Some(shared) = &config.publish.iceoryx2 {
        outputs.shared = Some(SharedSink::open(&config.publish, shared)?);
    }
    if let Some(recorder) = recorder(config, network)? {
        outputs.sinks.push(Box::new(recorder));
    }
    network_sinks(&config.publish, &mut outputs)?;
    Ok(outputs)
}

/// The recorder, if a file is named.
pub fn recorder(config: &Config, network: Option<&Matcher>) -> Result<Option<Recorder>> {
    let Some(path) = &config.recording.path else { return Ok(None) };
    let recorder = Recorder::open(
        &config.recording,
        &config.camera,
        &config.publish.namespace,
        &config.publish.body_frame,
        &provenance(config, network)?,
    )
    .with_context(|| format!("recording to {}", path.display()))?;
    Ok(Some(recorder))
}

fn network_sinks(config: &publish::Config, outputs: &mut Outputs) -> Result<()> {
    if let Some(ros2) = &config.ros2 {
        outputs.sinks.push(Box::new(publish::ros2::open(config, ros2)?));
    }
    if let Some(zenoh) = &config.zenoh {
        outputs.sinks.push(Box::new(publish::zenoh::open(config, zenoh)?));
    }
    if let Some(mavlink) = &config.mavlink {
        outputs.sinks.push(Box::new(publish::autopilot::mavlink::open(mavlink)?));
    }
    if let Some(px4) = &config.px4 {
        outputs.sinks.push(Box::new(publish::autopilot::px4::open(px4)?));
    }
    Ok(())
}

/// A bar for a finite source, a running line for a live one; nothing where standard error is no terminal.
pub fn progress(finite: bool) -> Result<ProgressBar> {
    let bar = ProgressBar::with_draw_target(Some(1000), ProgressDrawTarget::stderr_with_hz(10));
    let style = if finite { "{bar:40} {percent:>3} % {msg} {eta} left" } else { "{spinner} {elapsed} {msg}" };
    bar.set_style(ProgressStyle::with_template(style)?);
    Ok(bar)
}

/// Brings the bar up to the report.
fn advance(bar: &ProgressBar, report: &Report, progress: Option<f64>) {
    bar.set_position((progress.unwrap_or(0.0) * 1000.0) as u64);
    bar.set_message(format!(
        "{} frames, {} steps, {} displaced, {} spoiled",
        report.frames,
        report.steps,
        report.source.displaced,
        report.spoiled_count()
    ));
}
