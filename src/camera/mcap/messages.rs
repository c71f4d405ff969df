//! The whole messages of an MCAP file, in the order in which they stand, up to where the file is torn.

use std::{
    fs::File,
    io::{self, BufReader, Read, Seek, SeekFrom},
    path::Path,
};

use ::mcap::{
    MAGIC, McapError, Message, parse_record,
    read::ChannelAccumulator,
    records::{Metadata, Record, op},
    sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions},
};

/// The longest record or chunk that is believed, so that a hostile length can't ask for all memory.
pub const RECORD_BYTES_MAX: usize = 512 << 20;

/// An opcode and a length stand before every record.
const PREFIX: u64 = 9;
/// Start, end, uncompressed size, CRC and the length of the compression's name.
const CHUNK_FIXED: usize = 8 + 8 + 8 + 4 + 4;
/// A footer with its prefix and the closing magic.
const TAIL: u64 = PREFIX + 20 + 8;
/// `lz4`, `zstd` and whatever else is in use are far shorter.
const COMPRESSION_NAME_MAX: u32 = 64;
/// Declared size of a chunk that was never closed: more than a record may hold, and no sum of it overflows.
const UNKNOWN_SIZE: u64 = 1 << 40;

/// Where and why a file ends early.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tear {
    /// The byte at which the first unusable record begins.
    pub at: u64,
    /// What is missing or wrong there.
    pub reason: String,
}

impl std::fmt::Display for Tear {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "torn at byte {}: {}", self.at, self.reason)
    }
}

/// A chunk that is being read, fed to the decoder piece by piece.
struct Chunk {
    reader: LinearReader,
    left: u64,
    padding: u64,
}

/// Reads messages one by one; memory scales with the largest chunk, not with the file.
///
/// A closed chunk is checked against its CRC before its first message is given. A chunk that was never closed
/// (its length still says "unknown", or the file ends within it) gives every message that it holds whole.
pub struct Messages<R> {
    source: BufReader<R>,
    len: u64,
    at: u64,
    record_at: u64,
    channels: ChannelAccumulator<'static>,
    metadata: Vec<Metadata>,
    profile: String,
    compression: String,
    chunk: Option<Chunk>,
    body: Vec<u8>,
    ended: bool,
    tear: Option<Tear>,
}

impl Messages<File> {
    /// Opens a file.
    pub fn open(path: &Path) -> io::Result<Self> {
        Self::over(File::open(path)?)
    }
}

impl<R: Read + Seek> Messages<R> {
    /// Reads from anything that can seek. A source that does not begin as an MCAP file is torn at byte 0.
    pub fn over(mut source: R) -> io::Result<Self> {
        let len = source.seek(SeekFrom::End(0))?;
        source.seek(SeekFrom::Start(0))?;
        let mut messages = Self {
            source: BufReader::with_capacity(1 << 18, source),
            len,
            at: 0,
            record_at: 0,
            channels: ChannelAccumulator::default(),
            metadata: Vec::new(),
            profile: String::new(),
            compression: String::new(),
            chunk: None,
            body: Vec::new(),
            ended: false,
            tear: None,
        };
        let mut magic = [0; MAGIC.len()];
        if len < MAGIC.len() as u64 || messages.read_exact(&mut magic).is_err() || magic != *MAGIC {
            messages.end(Some(format!("expected an MCAP file of at least {} bytes, found none in {len}", MAGIC.len())));
        }
        Ok(messages)
    }

    /// Where the file is torn, known once the last message was given; `None` for a file that is whole.
    pub fn tear(&self) -> Option<&Tear> {
        self.tear.as_ref()
    }

    /// The metadata records that were passed so far.
    pub fn metadata(&self) -> &[Metadata] {
        &self.metadata
    }

    /// The profile in the file's header, `ros2` for ours; empty before the first message is asked for.
    pub fn profile(&self) -> &str {
        &self.profile
    }

    /// How the newest chunk was compressed, `lz4` or `zstd`; empty for not at all.
    pub fn compression(&self) -> &str {
        &self.compression
    }

    /// Bytes read and bytes in all.
    pub fn bytes(&self) -> (u64, u64) {
        (self.at, self.len)
    }

    fn end(&mut self, torn: Option<String>) {
        self.ended = true;
        self.chunk = None;
        self.tear = torn.map(|reason| Tear { at: self.record_at, reason });
    }

    fn read_exact(&mut self, into: &mut [u8]) -> Result<(), String> {
        self.source.read_exact(into).map_err(|e| format!("read fails: {e}"))?;
        self.at += into.len() as u64;
        Ok(())
    }

    fn skip(&mut self, bytes: u64) -> Result<(), String> {
        let by = i64::try_from(bytes).map_err(|_| format!("a record of {bytes} bytes"))?;
        self.source.seek_relative(by).map_err(|e| format!("seek fails: {e}"))?;
        self.at += bytes;
        Ok(())
    }

    /// One record outside of chunks.
    fn record(&mut self) -> Result<Option<Message<'static>>, String> {
        self.record_at = self.at;
        let left = self.len - self.at;
        if left < PREFIX {
            return Err(format!("expected a record, found {left} bytes: the file was never finished"));
        }
        let mut prefix = [0; PREFIX as usize];
        self.read_exact(&mut prefix)?;
        let [opcode, length @ ..] = prefix;
        let length = u64::from_le_bytes(length);
        let left = left - PREFIX;
        if opcode == op::CHUNK {
            return self.open_chunk(length, left).map(|()| None);
        }
        if length > left {
            return Err(format!("record {opcode:#04x} says {length} bytes, {left} are left"));
        }
        match opcode {
            op::DATA_END | op::FOOTER => {
                self.check_tail()?;
                self.end(None);
                Ok(None)
            }
            op::MESSAGE_INDEX | op::ATTACHMENT => self.skip(length).map(|()| None),
            _ => self.read_record(opcode, length),
        }
    }

    fn read_record(&mut self, opcode: u8, length: u64) -> Result<Option<Message<'static>>, String> {
        if length > RECORD_BYTES_MAX as u64 {
            return Err(format!("record {opcode:#04x} of {length} bytes, at most {RECORD_BYTES_MAX} are read"));
        }
        let mut body = std::mem::take(&mut self.body);
        body.resize(length as usize, 0);
        let read = self.read_exact(&mut body);
        let taken = read.and_then(|()| take(&mut self.channels, &mut self.metadata, &mut self.profile, opcode, &body));
        self.body = body;
        taken
    }

    /// The footer and the closing magic must stand at the very end.
    fn check_tail(&mut self) -> Result<(), String> {
        let torn = || "the summary at the end is not whole".to_string();
        if self.len < TAIL {
            return Err(torn());
        }
        let mut tail = [0; TAIL as usize];
        self.source.seek(SeekFrom::Start(self.len - TAIL)).map_err(|e| format!("seek fails: {e}"))?;
        self.source.read_exact(&mut tail).map_err(|e| format!("read fails: {e}"))?;
        self.at = self.len;
        let prefix = [op::FOOTER, 20, 0, 0, 0, 0, 0, 0, 0];
        if tail[..9] == prefix && tail[29..] == *MAGIC { Ok(()) } else { Err(torn()) }
    }

    /// Reads a chunk's header and hands it on to the decoder with sizes that hold for what is really there.
    fn open_chunk(&mut self, length: u64, left: u64) -> Result<(), String> {
        let short = || "the file ends within a chunk's header".to_string();
        let mut fixed = [0; CHUNK_FIXED];
        if left < CHUNK_FIXED as u64 {
            return Err(short());
        }
        self.read_exact(&mut fixed)?;
        let name_len = u32::from_le_bytes([fixed[28], fixed[29], fixed[30], fixed[31]]);
        if name_len > COMPRESSION_NAME_MAX {
            return Err(format!("a chunk's compression has a name of {name_len} bytes"));
        }
        let header = CHUNK_FIXED as u64 + u64::from(name_len) + 8;
        if left < header {
            return Err(short());
        }
        let mut name_and_size = [0; COMPRESSION_NAME_MAX as usize + 8];
        let name_and_size = &mut name_and_size[..name_len as usize + 8];
        self.read_exact(name_and_size)?;
        let (name, size) = name_and_size.split_at(name_len as usize);
        self.compression.clear();
        self.compression.push_str(&String::from_utf8_lossy(name));
        let declared = size.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte));
        let whole = length <= left && length.checked_sub(header).is_some_and(|room| declared <= room);
        if length <= left && !whole {
            return Err(format!("a chunk of {length} bytes says that it holds {declared}"));
        }
        let size = if whole { declared } else { left - header };
        if !whole {
            // Neither size nor CRC of a chunk that was never closed is known.
            fixed[16..24].copy_from_slice(&UNKNOWN_SIZE.to_le_bytes());
            fixed[24..28].fill(0);
        }
        let mut opening = Vec::with_capacity(PREFIX as usize + header as usize);
        opening.push(op::CHUNK);
        opening.extend((header + size).to_le_bytes());
        opening.extend(fixed);
        opening.extend_from_slice(name);
        opening.extend(size.to_le_bytes());
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(whole)
            .with_record_length_limit(RECORD_BYTES_MAX);
        let mut reader = LinearReader::new_with_options(options);
        reader.insert(opening.len()).copy_from_slice(&opening);
        reader.notify_read(opening.len());
        self.chunk = Some(Chunk { reader, left: size, padding: if whole { length - header - declared } else { 0 } });
        Ok(())
    }

    /// The next message of the open chunk; `None` when the chunk is done.
    fn chunked(&mut self) -> Result<Option<Message<'static>>, String> {
        let Some(chunk) = &mut self.chunk else { return Ok(None) };
        loop {
            match chunk.reader.next_event() {
                None => break,
                Some(Err(McapError::UnexpectedEof)) => return Err("the file ends within a chunk".into()),
                Some(Err(error)) => return Err(format!("chunk: {error}")),
                Some(Ok(LinearReadEvent::ReadRequest(need))) => {
                    let want = (need.min(1 << 20) as u64).min(chunk.left) as usize;
                    let room = chunk.reader.insert(want);
                    self.source.read_exact(room).map_err(|e| format!("read fails: {e}"))?;
                    chunk.reader.notify_read(want);
                    chunk.left -= want as u64;
                    self.at += want as u64;
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    let message = take(&mut self.channels, &mut self.metadata, &mut self.profile, opcode, data)?;
                    if message.is_some() {
                        return Ok(message);
                    }
                }
            }
        }
        let rest = chunk.left + chunk.padding;
        self.chunk = None;
        self.skip(rest).map(|()| None)
    }
}

/// Learns from a record, and gives the message that it holds.
fn take(
    channels: &mut ChannelAccumulator<'static>,
    metadata: &mut Vec<Metadata>,
    profile: &mut String,
    opcode: u8,
    body: &[u8],
) -> Result<Option<Message<'static>>, String> {
    let said = |e: McapError| format!("record {opcode:#04x}: {e}");
    match parse_record(opcode, body).map_err(said)? {
        Record::Header(header) => *profile = header.profile,
        Record::Schema { header, data } => channels.add_schema(header, data.into_owned().into()).map_err(said)?,
        Record::Channel(channel) => channels.add_channel(channel).map_err(said)?,
        Record::Metadata(record) => metadata.push(record),
        Record::Message { header, data } => {
            let channel = channels
                .get(header.channel_id)
                .ok_or_else(|| said(McapError::UnknownChannel(header.sequence, header.channel_id)))?;
            return Ok(Some(Message {
                channel,
                sequence: header.sequence,
                log_time: header.log_time,
                publish_time: header.publish_time,
                data: data.into_owned().into(),
            }));
        }
        _ => {}
    }
    Ok(None)
}

impl<R: Read + Seek> Iterator for Messages<R> {
    type Item = Message<'static>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.ended {
            let read = if self.chunk.is_some() { self.chunked() } else { self.record() };
            match read {
                Ok(Some(message)) => return Some(message),
                Ok(None) => {}
                Err(reason) => self.end(Some(reason)),
            }
        }
        None
    }
}
