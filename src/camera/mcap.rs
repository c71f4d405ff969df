//! Samples out of recordings: one MCAP file, or a folder of them as `ros2 bag record` leaves it.

mod messages;

use std::{
    collections::{BTreeMap, VecDeque},
    fs::File,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use ::mcap::{Channel, Message};
pub use messages::{Messages, Tear};

use super::{
    Config, Counts, Error, Frame, Mcap, Next, Sample, Source,
    latest::{self, Latest, SMALL_ROOM, Sender},
};
use crate::{clock, clock::Stamp, wire};

/// A pause in a recording is not waited for longer than this when its pace is kept.
const PAUSE_MAX: Duration = Duration::from_secs(5);

/// Opens the recording as it is asked for: every frame, or at its own pace with only the newest.
pub fn open(config: &Config, mcap: &Mcap) -> Result<Box<dyn Source>, Error> {
    let recording = Recording::open(&mcap.path, config)?;
    Ok(if mcap.realtime { Box::new(Paced::start(recording, config.exposure_s)?) } else { Box::new(recording) })
}

/// What a topic is read as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Frame,
    Info,
    Imu,
    Range,
    Transforms,
    Width,
}

impl Kind {
    fn definition(self) -> &'static str {
        match self {
            Kind::Frame => "sensor_msgs/msg/Image",
            Kind::Info => "sensor_msgs/msg/CameraInfo",
            Kind::Imu => "sensor_msgs/msg/Imu",
            Kind::Range => "sensor_msgs/msg/Range",
            Kind::Transforms => "tf2_msgs/msg/TFMessage",
            Kind::Width => "nightflow_msgs/msg/Width",
        }
    }
}

/// A recording that gives every sample, in the order in which it was written.
pub struct Recording {
    path: PathBuf,
    files: VecDeque<PathBuf>,
    open: Option<Messages<File>>,
    topics: [(String, Kind); 6],
    /// Channels of the open file whose kind was settled.
    settled: BTreeMap<u16, Option<Kind>>,
    /// Topics that were seen but not asked for.
    others: Vec<String>,
    counts: Counts,
    bytes: u64,
    bytes_done: u64,
    tears: Vec<(PathBuf, Tear)>,
    ended: bool,
}

impl Recording {
    /// Opens a file, or a folder whose files are read one after the other.
    pub fn open(path: &Path, config: &Config) -> Result<Self, Error> {
        let lost = |reason: String| Error::Lost { source_name: path.display().to_string(), reason };
        let files = files(path).map_err(|e| lost(e.to_string()))?;
        if files.is_empty() {
            return Err(lost("expected a folder with .mcap files, found none in it".into()));
        }
        let mut bytes = 0;
        for file in &files {
            bytes += file.metadata().map_err(|e| lost(e.to_string()))?.len();
        }
        let named = |topic: &String, kind| (topic.clone(), kind);
        let mut recording = Self {
            path: path.into(),
            files: files.into(),
            open: None,
            topics: [
                named(&config.image_topic, Kind::Frame),
                named(&config.info_topic, Kind::Info),
                named(&config.imu_topic, Kind::Imu),
                named(&config.range_topic, Kind::Range),
                named(&config.tf_topic, Kind::Transforms),
                named(&config.width_topic, Kind::Width),
            ],
            settled: BTreeMap::new(),
            others: Vec::new(),
            counts: Counts::default(),
            bytes: bytes.max(1),
            bytes_done: 0,
            tears: Vec::new(),
            ended: false,
        };
        recording.turn()?;
        if let Some(tear) = recording.open.as_ref().and_then(Messages::tear) {
            return Err(lost(tear.reason.clone()));
        }
        Ok(recording)
    }

    /// The files that end early, and where; complete once the source has ended.
    pub fn tears(&self) -> &[(PathBuf, Tear)] {
        &self.tears
    }

    /// Leaves the open file and opens the next one; false when there is none.
    fn turn(&mut self) -> Result<bool, Error> {
        self.open = None;
        let Some(path) = self.files.pop_front() else { return Ok(false) };
        let lost = |e: std::io::Error| Error::Lost { source_name: path.display().to_string(), reason: e.to_string() };
        self.open = Some(Messages::open(&path).map_err(lost)?);
        self.settled.clear();
        self.path = path;
        Ok(true)
    }

    /// The next wanted message, with its time of arrival.
    fn sample(&mut self) -> Result<Option<(Stamp, Sample)>, Error> {
        while let Some(messages) = &mut self.open {
            let Some(message) = messages.next() else {
                self.bytes_done += messages.bytes().1;
                if let Some(tear) = messages.tear() {
                    tracing::warn!(target: "nightflow::camera", "{}: {tear}; all before it was read", self.path.display());
                    self.tears.push((self.path.clone(), tear.clone()));
                }
                self.turn()?;
                continue;
            };
            let Some(kind) = self.settle(&message.channel)? else { continue };
            let received = Stamp::from_ns(i64::try_from(message.log_time).unwrap_or(i64::MAX));
            return match decoded(kind, &message, received) {
                Ok(sample) => {
                    self.counts.arrived += u64::from(kind == Kind::Frame);
                    Ok(Some((received, sample)))
                }
                Err(error) => {
                    self.counts.torn += 1;
                    Err(Error::Torn { topic: message.channel.topic.clone(), reason: error.to_string() })
                }
            };
        }
        Ok(None)
    }

    /// Decides once a channel whether it is wanted, and refuses one that is not what its topic should carry.
    fn settle(&mut self, channel: &Channel<'_>) -> Result<Option<Kind>, Error> {
        if let Some(kind) = self.settled.get(&channel.id) {
            return Ok(*kind);
        }
        let wanted = self.topics.iter().find(|(topic, _)| *topic == channel.topic).map(|(_, kind)| *kind);
        // Whatever is wrong with it is said once; its other messages are passed over.
        self.settled.insert(channel.id, None);
        let Some(kind) = wanted else {
            if !self.others.contains(&channel.topic) {
                self.others.push(channel.topic.clone());
            }
            return Ok(None);
        };
        let found = channel.schema.as_ref().map_or("no schema", |schema| &schema.name);
        if found != kind.definition() || channel.message_encoding != "cdr" {
            return Err(Error::Settings(format!(
                "{}: topic {}: expected {} encoded as cdr, found {found} encoded as {}",
                self.path.display(),
                channel.topic,
                kind.definition(),
                if channel.message_encoding.is_empty() { "nothing" } else { &channel.message_encoding },
            )));
        }
        self.settled.insert(channel.id, Some(kind));
        Ok(Some(kind))
    }

    /// A recording without a single frame is a mistake in the settings, and the topics that it has are the remedy.
    fn end(&mut self) -> Result<Next, Error> {
        let first = !std::mem::replace(&mut self.ended, true);
        if first && self.counts.arrived == 0 && self.counts.torn == 0 {
            self.others.sort();
            let has = if self.others.is_empty() { "no message at all".into() } else { self.others.join(", ") };
            let reason = format!("{}: expected frames on {}, found {has}", self.path.display(), self.topics[0].0);
            return Err(Error::Settings(reason));
        }
        Ok(Next::End)
    }
}

impl Source for Recording {
    fn next(&mut self, _wait: Duration) -> Result<Next, Error> {
        match self.sample()? {
            Some((_, sample)) => Ok(Next::Sample(sample)),
            None => self.end(),
        }
    }

    fn counts(&self) -> Counts {
        self.counts
    }

    fn progress(&self) -> Option<f64> {
        let read = self.open.as_ref().map_or(0, |messages| messages.bytes().0);
        Some((self.bytes_done + read) as f64 / self.bytes as f64)
    }
}

fn decoded(kind: Kind, message: &Message<'_>, received: Stamp) -> Result<Sample, wire::Error> {
    Ok(match kind {
        Kind::Frame => Sample::Frame(Arc::new(Frame { image: wire::decode(&message.data)?, received })),
        Kind::Info => Sample::Info(Arc::new(wire::decode(&message.data)?)),
        Kind::Imu => Sample::Imu(Arc::new(wire::decode(&message.data)?)),
        Kind::Range => Sample::Range(Arc::new(wire::decode(&message.data)?)),
        Kind::Transforms => Sample::Transforms(Arc::new(wire::decode(&message.data)?)),
        Kind::Width => Sample::Width(Arc::new(wire::decode(&message.data)?)),
    })
}

/// A recording's files: itself, or the `.mcap` files of a folder in the order of the number that rosbag2 puts at the end of their names.
pub fn files(recording: &Path) -> std::io::Result<Vec<PathBuf>> {
    if !recording.is_dir() {
        return Ok(vec![recording.to_owned()]);
    }
    let mut files = Vec::new();
    for entry in std::fs::read_dir(recording)? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "mcap") {
            files.push(path);
        }
    }
    files.sort_by_cached_key(|path| {
        let stem = path.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
        let number = stem.rsplit_once('_').and_then(|(_, number)| number.parse::<u64>().ok());
        (number, stem)
    });
    Ok(files)
}

/// A recording played at its own pace into the mailbox that live cameras use.
pub struct Paced {
    latest: Latest,
    stop: Arc<AtomicBool>,
    /// Progress as the bits of an `f64`.
    progress: Arc<AtomicU64>,
    playing: Option<JoinHandle<()>>,
}

impl Paced {
    fn start(recording: Recording, exposure_s: f64) -> Result<Self, Error> {
        let (sender, latest) = latest::mailbox(SMALL_ROOM);
        let latest = latest.exposing(exposure_s);
        let (stop, progress) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let name = recording.path.display().to_string();
        let playing = {
            let (stop, progress) = (Arc::clone(&stop), Arc::clone(&progress));
            std::thread::Builder::new()
                .name("playing".into())
                .spawn(move || play(recording, &sender, &stop, &progress))
                .map_err(|e| Error::Lost { source_name: name, reason: format!("its thread can't be started: {e}") })?
        };
        Ok(Self { latest, stop, progress, playing: Some(playing) })
    }
}

/// Sends each sample when its time has come. A sample that can't be decoded is counted, all else ends the play.
fn play(mut recording: Recording, sender: &Sender, stop: &AtomicBool, progress: &AtomicU64) {
    let mut due = clock::instant();
    let mut last: Option<Stamp> = None;
    while !stop.load(Ordering::Acquire) {
        match recording.sample() {
            Ok(Some((received, sample))) => {
                let pause = last.map_or(0, |last| received.ns().saturating_sub(last.ns()).max(0));
                due += Duration::from_nanos(pause.unsigned_abs()).min(PAUSE_MAX);
                last = Some(received);
                while !stop.load(Ordering::Acquire) {
                    let left = due.saturating_duration_since(clock::instant());
                    if left.is_zero() {
                        break;
                    }
                    std::thread::sleep(left.min(Duration::from_millis(50)));
                }
                // What another run could keep up with says nothing about this one.
                if !matches!(sample, Sample::Width(_)) {
                    sender.put(now_received(sample));
                }
            }
            Ok(None) => {
                progress.store(1_f64.to_bits(), Ordering::Relaxed);
                return recording.end().map_or_else(|error| sender.fail(error), |_| ());
            }
            Err(Error::Torn { topic, reason }) => {
                tracing::warn!(target: "nightflow::camera", "a message on {topic} is torn: {reason}");
                sender.torn();
            }
            Err(error) => return sender.fail(error),
        }
        progress.store(recording.progress().unwrap_or(0.0).to_bits(), Ordering::Relaxed);
    }
}

/// A frame that is played arrives now.
fn now_received(sample: Sample) -> Sample {
    match sample {
        Sample::Frame(mut frame) => {
            if let Some(frame) = Arc::get_mut(&mut frame) {
                frame.received = clock::now();
            }
            Sample::Frame(frame)
        }
        small => small,
    }
}

impl Source for Paced {
    fn next(&mut self, wait: Duration) -> Result<Next, Error> {
        self.latest.next(wait)
    }

    fn counts(&self) -> Counts {
        self.latest.counts()
    }

    fn progress(&self) -> Option<f64> {
        Some(f64::from_bits(self.progress.load(Ordering::Relaxed)))
    }
}

impl Drop for Paced {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(playing) = self.playing.take() {
            // It ended or ends within a tick; a panic in it was printed by then.
            let _ = playing.join();
        }
    }
}
