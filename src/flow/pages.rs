//! Large pages for the memory that a network works in: with small ones a processor spends part of a step looking up where its
//! weights and maps lie.
//!
//! Linux gives large pages to whoever asks for them before memory is first touched, which neither an allocator nor ONNX Runtime
//! does, and since 6.1 at any time: then what is there is moved. So the node asks once all memory of a size of frames is taken, for a
//! piece with every step: all at once would cost a stream some frames.

use std::{
    fs::{self, File},
    io::{self, Read as _, Seek as _, SeekFrom},
    ops::Range,
    path::{Path, PathBuf},
};

use thiserror::Error;

const SIZE: &str = "/sys/kernel/mm/transparent_hugepage/hpage_pmd_size";
const ENABLED: &str = "/sys/kernel/mm/transparent_hugepage/enabled";
const MAPS: &str = "/proc/self/maps";
const PAGEMAP: &str = "/proc/self/pagemap";
/// Of an entry of the page map: the page is in memory.
const PRESENT: u64 = 1 << 63;
/// Memory becomes a large page if more than such a part of it is in use: what is not would be taken too.
const USED_PART_MIN: f64 = 0.75;

/// Why pages stay small.
#[derive(Debug, Error)]
pub enum Small {
    /// There are none, or they can't be asked for.
    #[error("{path}: {reason}")]
    Read {
        /// A file of the kernel's.
        path: PathBuf,
        /// What was wrong with it.
        reason: io::Error,
    },
    /// Whoever keeps the machine wants none.
    #[error("{ENABLED} says never")]
    Never,
    /// The kernel moved nothing.
    #[error("expected Linux 6.1 or later, which moves memory to large pages when asked: {0}")]
    Refused(io::Error),
}

/// Memory that lies on large pages now or lay there before, and how much might have, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moved {
    /// On large pages.
    pub large: usize,
    /// In pieces of which enough is in use.
    pub of: usize,
}

/// Memory that is to lie on large pages.
#[derive(Debug)]
pub struct Moving {
    /// Where pieces begin that are still to be moved, and their size.
    left: Vec<usize>,
    large: usize,
    moved: Moved,
    refused: Option<io::Error>,
}

impl Moving {
    /// The private memory of this process, as far as whole large pages of it are in use.
    pub fn found() -> Result<Self, Small> {
        if text(ENABLED)?.contains("[never]") {
            return Err(Small::Never);
        }
        let wrong = |reason: &str| Small::Read { path: SIZE.into(), reason: io::Error::other(reason.to_owned()) };
        let large: usize = text(SIZE)?.trim().parse().map_err(|_| wrong("expected a number of bytes"))?;
        // SAFETY: it takes a number and gives one.
        let small = usize::try_from(unsafe { libc::sysconf(libc::_SC_PAGESIZE) }).unwrap_or(0);
        if small == 0 || large < 2 * small {
            return Err(wrong("expected more than a small page"));
        }
        let mut pagemap = File::open(PAGEMAP).map_err(|reason| failed(PAGEMAP, reason))?;
        let (mut left, mut entries) = (vec![], vec![0; large / small * size_of::<u64>()]);
        for memory in text(MAPS)?.lines().filter_map(private) {
            let pieces = (memory.start.next_multiple_of(large)..memory.end).step_by(large);
            let whole = pieces.filter(|first| first + large <= memory.end);
            left.extend(whole.filter(|first| used(&mut pagemap, first / small, &mut entries)));
        }
        let moved = Moved { large: 0, of: large * left.len() };
        Ok(Self { left, large, moved, refused: None })
    }

    /// Moves a piece, which takes one to nine milliseconds, or none where it lies there already; whether there are more. Nothing in it changes.
    pub fn step(&mut self) -> bool {
        if let Some(first) = self.left.pop() {
            match ask(first, self.large) {
                Ok(()) => self.moved.large += self.large,
                Err(why) => self.refused = Some(why),
            }
        }
        !self.left.is_empty()
    }

    /// What became of it.
    pub fn end(self) -> Result<Moved, Small> {
        match self.refused {
            Some(why) if self.moved.large == 0 => Err(Small::Refused(why)),
            _ => Ok(self.moved),
        }
    }
}

/// Moves all of it at once.
pub fn enlarge() -> Result<Moved, Small> {
    let mut moving = Moving::found()?;
    while moving.step() {}
    moving.end()
}

fn text(path: &str) -> Result<String, Small> {
    fs::read_to_string(path).map_err(|reason| failed(path, reason))
}

fn failed(path: impl AsRef<Path>, reason: io::Error) -> Small {
    Small::Read { path: path.as_ref().into(), reason }
}

/// Where a line of [`MAPS`] says that memory lies which is written to, belongs to this process alone and comes from no file.
fn private(line: &str) -> Option<Range<usize>> {
    let mut words = line.split_ascii_whitespace();
    let (range, rights, _, _, file) = (words.next()?, words.next()?, words.next()?, words.next()?, words.next()?);
    let named = words.next().is_some_and(|name| name != "[heap]");
    let (start, end) = range.split_once('-')?;
    let number = |text: &str| usize::from_str_radix(text, 16).ok();
    (rights == "rw-p" && file == "0" && !named).then_some(number(start)?..number(end)?)
}

/// Whether enough of the small pages is in memory, from the one of this number on.
fn used(pagemap: &mut File, first: usize, entries: &mut [u8]) -> bool {
    let at = SeekFrom::Start((first * size_of::<u64>()) as u64);
    if pagemap.seek(at).and_then(|_| pagemap.read_exact(entries)).is_err() {
        return false;
    }
    let (entries, _) = entries.as_chunks();
    let present = entries.iter().filter(|entry| u64::from_ne_bytes(**entry) & PRESENT != 0).count();
    present as f64 > USED_PART_MIN * entries.len() as f64
}

fn ask(first: usize, length: usize) -> io::Result<()> {
    // Not `MADV_HUGEPAGE`, which lasts: whoever takes memory there later would wait for a large page to be made free and cleared.
    // SAFETY: it says on what pages memory should lie and leaves what is in it as it is; if there is none any more, the kernel says so.
    match unsafe { libc::madvise(std::ptr::without_provenance_mut(first), length, libc::MADV_COLLAPSE) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_of_this_process_alone_is_told_from_other() {
        for (line, wanted) in [
            ("7f0000000000-7f0000600000 rw-p 00000000 00:00 0 ", Some(0x7f00_0000_0000..0x7f00_0060_0000)),
            (
                "55d0c0000000-55d0c0021000 rw-p 00000000 00:00 0                          [heap]",
                Some(0x55d0_c000_0000..0x55d0_c002_1000),
            ),
            ("7ffd00000000-7ffd00021000 rw-p 00000000 00:00 0                          [stack]", None),
            ("7f0000000000-7f0000600000 rw-s 00000000 00:19 12                         /dev/shm/iox2_frames", None),
            ("7f0000000000-7f0000600000 rw-p 00000000 fe:00 17                         /usr/lib/libc.so.6", None),
            ("7f0000000000-7f0000600000 ---p 00000000 00:00 0 ", None),
            ("torn", None),
            ("xyz-1 rw-p 00000000 00:00 0", None),
        ] {
            assert_eq!(private(line), wanted, "{line}");
        }
    }

    #[test]
    fn what_is_in_use_moves_and_what_is_not_stays() {
        const LENGTH: usize = 16 << 20;
        let written: Vec<u32> = (0..LENGTH as u32 / 4).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let untouched = vec![0u32; LENGTH / 4];
        let before = resident(&untouched);
        match enlarge() {
            Ok(moved) => {
                // The first and the last page of the memory are not whole ones.
                assert!(moved.large >= LENGTH - (4 << 20) && moved.of >= moved.large, "{moved:?}");
                println!("{moved:?}");
            }
            // Where memory has to stay, that is so.
            Err(Small::Never) => assert!(text(ENABLED).unwrap().contains("[never]")),
            Err(Small::Read { path, .. }) => assert!(!path.exists(), "{path:?}"),
            Err(Small::Refused(why)) => assert!(kernel() < [6, 1], "{why}"),
        }
        assert!(written.iter().enumerate().all(|(i, value)| *value == (i as u32).wrapping_mul(2_654_435_761)));
        assert_eq!(resident(&untouched), before, "memory that nobody used was taken");
    }

    /// Its version.
    fn kernel() -> [u32; 2] {
        let text = text("/proc/sys/kernel/osrelease").unwrap();
        let mut numbers = text.split(['.', '-']).map(|number| number.parse().unwrap());
        [numbers.next().unwrap(), numbers.next().unwrap()]
    }

    /// Bytes that are in use of the large pages that lie in this memory alone: the first and the last may be shared with somebody who
    /// uses them, and move with him.
    fn resident(memory: &[u32]) -> usize {
        let mut pagemap = File::open(PAGEMAP).unwrap();
        let large = text(SIZE).ok().and_then(|size| size.trim().parse().ok()).unwrap_or(2 << 20);
        let bounds = memory.as_ptr_range();
        let (first, last) = (bounds.start.addr().next_multiple_of(large), bounds.end.addr() / large * large);
        let (first, last) = (first / 4096, last / 4096);
        let mut entries = vec![0; (last - first) * 8];
        pagemap.seek(SeekFrom::Start(first as u64 * 8)).unwrap();
        pagemap.read_exact(&mut entries).unwrap();
        let (entries, _) = entries.as_chunks();
        4096 * entries.iter().filter(|entry| u64::from_ne_bytes(**entry) & PRESENT != 0).count()
    }
}
