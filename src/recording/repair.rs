//! A torn recording becomes one that every reader opens.

use std::{
    collections::BTreeMap,
    ffi::OsString,
    fs::{self, File},
    io::BufWriter,
    path::{Path, PathBuf},
};

use super::{
    Compression, Error,
    writer::{options, sync_folder},
};
use crate::camera::mcap::{Messages, Tear};

/// What becomes of the torn file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Original {
    /// It stays, and the repaired one is `NAME.repaired.mcap` beside it.
    Keep,
    /// The repaired one takes its place.
    Replace,
}

/// What a repair found and did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Repaired {
    /// The file to read: the repaired one, or the original when it was whole.
    pub path: PathBuf,
    /// Messages that it holds.
    pub messages: u64,
    /// The same by topic.
    pub by_topic: BTreeMap<String, u64>,
    /// Where the original was torn; `None` when it was whole and nothing was written.
    pub tear: Option<Tear>,
}

/// Keeps every whole message up to the tear, writes them with a summary to a new file beside the old one, and gives it
/// its name only when all of it is on the disk. A file that is whole stays as it is.
pub fn repair(path: &Path, original: Original) -> Result<Repaired, Error> {
    let io = |source| Error::Io { path: path.into(), source };
    let mut messages = Messages::open(path).map_err(io)?;
    if let Some(tear) = messages.tear() {
        return Err(Error::Unreadable { path: path.into(), reason: tear.reason.clone() });
    }
    let mut by_topic = BTreeMap::new();
    for message in messages.by_ref() {
        count(&mut by_topic, &message.channel.topic);
    }
    let messages_kept = by_topic.values().sum();
    let Some(tear) = messages.tear().cloned() else {
        return Ok(Repaired { path: path.into(), messages: messages_kept, by_topic, tear: None });
    };
    let target = match original {
        Original::Replace => path.to_owned(),
        Original::Keep => path.with_extension("repaired.mcap"),
    };
    let beside = with_suffix(path, ".part");
    let copied = Messages::open(path).map_err(io).and_then(|mut messages| copy(&mut messages, &beside));
    if let Err(error) = copied {
        // Half a repair is of no use to anybody.
        let _ = fs::remove_file(&beside);
        return Err(error);
    }
    fs::rename(&beside, &target).and_then(|()| sync_folder(&target)).map_err(io)?;
    Ok(Repaired { path: target, messages: messages_kept, by_topic, tear: Some(tear) })
}

fn count(by_topic: &mut BTreeMap<String, u64>, topic: &str) {
    match by_topic.get_mut(topic) {
        Some(count) => *count += 1,
        None => _ = by_topic.insert(topic.to_owned(), 1),
    }
}

fn copy(messages: &mut Messages<File>, to: &Path) -> Result<(), Error> {
    let io = |source| Error::Io { path: to.into(), source };
    let wrong = |source| Error::Mcap { path: to.into(), source };
    let mut first = messages.next();
    let compression = match messages.compression() {
        "" => Compression::None,
        "zstd" => Compression::Zstd,
        _ => Compression::Lz4,
    };
    let file = File::create(to).map_err(io)?;
    let synced = file.try_clone().map_err(io)?;
    let mut mcap = options(compression)
        .profile(messages.profile())
        .create(BufWriter::with_capacity(1 << 18, file))
        .map_err(wrong)?;
    let mut attached = 0;
    loop {
        for record in &messages.metadata()[attached..] {
            mcap.write_metadata(record).map_err(wrong)?;
        }
        attached = messages.metadata().len();
        let Some(message) = first.take().or_else(|| messages.next()) else { break };
        mcap.write(&message).map_err(wrong)?;
    }
    for record in &messages.metadata()[attached..] {
        mcap.write_metadata(record).map_err(wrong)?;
    }
    mcap.finish().map_err(wrong)?;
    synced.sync_all().map_err(io)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(suffix);
    name.into()
}
