//! Writes MCAP files that `ros2 bag`, Foxglove and the Python readers open.

use std::{
    collections::BTreeMap,
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};

use ::mcap::{
    WriteOptions,
    records::{MessageHeader, Metadata},
};

use super::{Compression, Config, Error, rosbag2};
use crate::{clock::Stamp, wire};

/// Two frames of 640×480×16 bit fill a chunk about four times over: large enough for the compressor and for seeking,
/// small enough that a reader holds little.
const CHUNK_BYTES: u64 = 4 << 20;

/// What a channel says of its messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Definition<'a> {
    /// `sensor_msgs/msg/Image`.
    pub name: &'a str,
    /// The `.msg` text with all that it depends on, as `ros2msg` asks.
    pub text: &'a str,
    /// `RIHS01_…`.
    pub hash: &'a str,
}

/// One topic of the file.
#[derive(Debug)]
pub(super) struct Topic {
    id: u16,
    sequence: u32,
    pub(super) definition: String,
    pub(super) hash: String,
    pub(super) qos: String,
    pub(super) messages: u64,
}

/// An MCAP file that is being written; the same calls give the same bytes.
pub struct Writer {
    path: PathBuf,
    mcap: ::mcap::Writer<BufWriter<File>>,
    file: File,
    topics: BTreeMap<String, Topic>,
    span: Option<(Stamp, Stamp)>,
    cdr: Vec<u8>,
}

impl Writer {
    /// Creates the file, or empties it; nothing but the compression is taken from the settings.
    pub fn create(path: &Path, config: &Config) -> Result<Self, Error> {
        let io = |source| Error::Io { path: path.into(), source };
        let file = File::create(path).map_err(io)?;
        let synced = file.try_clone().map_err(io)?;
        let mcap = options(config.compression)
            .create(BufWriter::with_capacity(1 << 18, file))
            .map_err(|source| Error::Mcap { path: path.into(), source })?;
        let mut writer =
            Self { path: path.into(), mcap, file: synced, topics: BTreeMap::new(), span: None, cdr: Vec::new() };
        writer.sync()?;
        sync_folder(path).map_err(io)?;
        Ok(writer)
    }

    /// Where the file is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a message; its schema and channel are made with the first one of a topic.
    pub fn write<M: wire::Message>(
        &mut self,
        topic: &str,
        log_time: Stamp,
        publish_time: Stamp,
        message: &M,
    ) -> Result<(), Error> {
        if !self.topics.contains_key(topic) {
            let (name, text, hash) = (wire::ros_name::<M>(), wire::schema::<M>(), wire::type_hash::<M>());
            self.open_topic(topic, &Definition { name: &name, text: &text, hash: &hash })?;
        }
        let mut cdr = std::mem::take(&mut self.cdr);
        let written = wire::encode(message, &mut cdr)
            .map_err(Error::from)
            .and_then(|()| self.put(topic, &[M::PACKAGE, "/msg/", M::NAME], log_time, publish_time, &cdr));
        self.cdr = cdr;
        written
    }

    /// Writes a message that is CDR already, with its four bytes of encapsulation.
    pub fn write_cdr(
        &mut self,
        topic: &str,
        definition: &Definition<'_>,
        log_time: Stamp,
        publish_time: Stamp,
        cdr: &[u8],
    ) -> Result<(), Error> {
        if !self.topics.contains_key(topic) {
            self.open_topic(topic, definition)?;
        }
        self.put(topic, &[definition.name], log_time, publish_time, cdr)
    }

    /// Writes to a topic that is open; `definition` is a name in parts, so that comparing it allocates nothing.
    fn put(
        &mut self,
        topic: &str,
        definition: &[&str],
        log_time: Stamp,
        publish_time: Stamp,
        cdr: &[u8],
    ) -> Result<(), Error> {
        let Some(open) = self.topics.get_mut(topic) else { return Ok(()) };
        let rest = definition.iter().try_fold(open.definition.as_str(), |rest, part| rest.strip_prefix(part));
        if rest != Some("") {
            return Err(Error::Type {
                topic: topic.into(),
                expected: open.definition.clone(),
                found: definition.concat(),
            });
        }
        let header = MessageHeader {
            channel_id: open.id,
            sequence: open.sequence,
            log_time: unsigned(log_time),
            publish_time: unsigned(publish_time),
        };
        self.mcap
            .write_to_known_channel(&header, cdr)
            .map_err(|source| Error::Mcap { path: self.path.clone(), source })?;
        open.sequence = open.sequence.wrapping_add(1);
        open.messages += 1;
        let (first, last) = self.span.unwrap_or((log_time, log_time));
        self.span = Some((first.min(log_time), last.max(log_time)));
        Ok(())
    }

    /// Leaves out sequence numbers of a topic, so that a reader sees how many of its messages were lost here.
    pub fn skip(&mut self, topic: &str, lost: u32) {
        if let Some(open) = self.topics.get_mut(topic) {
            open.sequence = open.sequence.wrapping_add(lost);
        }
    }

    /// Writes a metadata record.
    pub fn attach_metadata(&mut self, name: &str, entries: &BTreeMap<String, String>) -> Result<(), Error> {
        let record = Metadata { name: name.into(), metadata: entries.clone() };
        self.mcap.write_metadata(&record).map_err(|source| Error::Mcap { path: self.path.clone(), source })
    }

    /// Closes the chunk and waits until everything written so far is on the disk.
    pub fn sync(&mut self) -> Result<(), Error> {
        self.mcap.flush().map_err(|source| Error::Mcap { path: self.path.clone(), source })?;
        self.file.sync_data().map_err(|source| Error::Io { path: self.path.clone(), source })
    }

    /// Writes rosbag2's metadata, the summary and the footer, and waits for the disk.
    pub fn finish(mut self) -> Result<(), Error> {
        let name = self.path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        let yaml = rosbag2::bag_metadata(&name, &self.topics, self.span);
        self.attach_metadata("rosbag2", &BTreeMap::from([("serialized_metadata".to_owned(), yaml)]))?;
        self.mcap.finish().map_err(|source| Error::Mcap { path: self.path.clone(), source })?;
        self.file.sync_all().map_err(|source| Error::Io { path: self.path.clone(), source })
    }

    fn open_topic(&mut self, topic: &str, definition: &Definition<'_>) -> Result<(), Error> {
        let qos = rosbag2::offered_qos(definition.name);
        let metadata = BTreeMap::from([
            ("offered_qos_profiles".to_owned(), qos.clone()),
            ("topic_type_hash".to_owned(), definition.hash.to_owned()),
        ]);
        let id = self
            .mcap
            .add_schema(definition.name, "ros2msg", definition.text.as_bytes())
            .and_then(|schema| self.mcap.add_channel(schema, topic, "cdr", &metadata))
            .map_err(|source| Error::Mcap { path: self.path.clone(), source })?;
        let hash = definition.hash.to_owned();
        let definition = definition.name.to_owned();
        self.topics.insert(topic.into(), Topic { id, sequence: 0, definition, hash, qos, messages: 0 });
        Ok(())
    }
}

/// How our files are written; one thread, because the number of threads would show in zstd's bytes.
pub(super) fn options(compression: Compression) -> WriteOptions {
    let compression = match compression {
        Compression::None => None,
        Compression::Lz4 => Some(::mcap::Compression::Lz4),
        Compression::Zstd => Some(::mcap::Compression::Zstd),
    };
    WriteOptions::new()
        .profile("ros2")
        .library(concat!("nightflow ", env!("CARGO_PKG_VERSION")))
        .compression(compression)
        .compression_threads(0)
        .chunk_size(Some(CHUNK_BYTES))
}

/// A new file's name is safe only when its folder is.
pub(super) fn sync_folder(path: &Path) -> std::io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

fn unsigned(stamp: Stamp) -> u64 {
    u64::try_from(stamp.ns()).unwrap_or(0)
}
