//! Torn recordings: cut at any byte, killed while they were written, repaired.

use std::{
    fs,
    io::{BufRead, BufReader, Cursor},
    path::Path,
    process::{Command, Stdio},
    time::Duration,
};

use nightflow::{
    camera::{self, Sample, mcap::Messages},
    clock::Stamp,
    flow::State,
    publish::Sink,
    recording::{self, Compression, Config, Original, Outputs, Recorder, Writer, repair},
};
use proptest::prelude::*;

use super::{
    peers,
    recording::{frame, image, imu, info, moved, offer, range, read, settings},
};

/// A small recording in several chunks; every third message closes one.
fn small_file(folder: &Path, compression: Compression) -> Vec<u8> {
    let path = folder.join("small.mcap");
    let mut writer = Writer::create(&path, &Config { compression, ..Config::default() }).unwrap();
    writer.attach_metadata("nightflow", &settings()).unwrap();
    for k in 0..9 {
        let image = image(k, 4, 2);
        let stamp = image.header.stamp.into();
        writer.write("/camera/image_raw", stamp, stamp, &image).unwrap();
        if k % 3 == 2 {
            writer.sync().unwrap();
        }
    }
    writer.finish().unwrap();
    fs::read(&path).unwrap()
}

fn messages(bytes: &[u8]) -> (Vec<Vec<u8>>, bool) {
    let mut messages = Messages::over(Cursor::new(bytes)).unwrap();
    let all = messages.by_ref().map(|message| message.data.into_owned()).collect();
    (all, messages.tear().is_some())
}

#[test]
fn a_file_torn_at_any_byte_gives_a_prefix() {
    let folder = tempfile::tempdir().unwrap();
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        let whole = small_file(folder.path(), compression);
        let (all, torn) = messages(&whole);
        assert!(all.len() == 9 && !torn);
        let mut most = 0;
        for at in 0..whole.len() {
            let (kept, torn) = messages(&whole[..at]);
            assert!(torn, "{at} of {} bytes are no whole file", whole.len());
            assert!(all.starts_with(&kept), "{compression:?}: what is kept of {at} bytes is no prefix");
            assert!(kept.len() >= most, "{compression:?}: {at} bytes give fewer messages than {} do", at - 1);
            most = kept.len();
        }
        assert_eq!(most, 9, "the summary alone costs no message");
    }
}

#[test]
fn an_open_chunk_gives_what_it_holds_whole() {
    let folder = tempfile::tempdir().unwrap();
    let whole = small_file(folder.path(), Compression::None);
    // The writer leaves ones for the lengths that it does not know yet.
    let chunks: Vec<usize> = {
        let mut at = 8;
        let mut found = Vec::new();
        while at + 9 <= whole.len() {
            let length = u64::from_le_bytes(whole[at + 1..at + 9].try_into().unwrap()) as usize;
            if whole[at] == 6 {
                found.push(at);
            }
            at += 9 + length;
        }
        found
    };
    let last = chunks[2];
    let mut open = whole.clone();
    open[last + 1..last + 9].fill(0xff);
    open[last + 9 + 16..last + 9 + 28].fill(0xff);
    open[last + 9 + 32..last + 9 + 40].fill(0xff);
    let second = messages(&open[..last + 9 + 40]).0.len();
    assert_eq!(second, 6);
    let record = 9 + 22 + messages(&whole).0[0].len();
    for (bytes, kept) in [(record - 1, 6), (record, 7), (2 * record, 8), (3 * record, 9)] {
        assert_eq!(messages(&open[..last + 9 + 40 + bytes]).0.len(), kept, "{bytes} bytes of the open chunk");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn no_bytes_make_the_reader_panic(
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        kind in 0..3,
    ) {
        let folder = tempfile::tempdir().unwrap();
        let compression = [Compression::None, Compression::Lz4, Compression::Zstd][kind as usize];
        let mut bytes = small_file(folder.path(), compression);
        let all = messages(&bytes).0;
        for (index, byte) in flips {
            let at = index.index(bytes.len());
            bytes[at] = byte;
        }
        let (kept, _) = messages(&bytes);
        prop_assert!(kept.len() <= all.len());
    }
}

#[test]
fn a_repaired_file_is_whole_and_a_whole_file_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("torn.mcap");
    let whole = small_file(folder.path(), Compression::Zstd);
    let two_chunks = (0..whole.len()).find(|at| messages(&whole[..*at]).0.len() == 6).unwrap();
    let torn = &whole[..two_chunks + 60];
    fs::write(&path, torn).unwrap();
    let kept = messages(torn).0;
    assert_eq!(kept.len(), 6);

    let repaired = repair(&path, Original::Keep).unwrap();
    assert_eq!(repaired.path, folder.path().join("torn.repaired.mcap"));
    assert_eq!(repaired.messages, kept.len() as u64);
    assert_eq!(repaired.by_topic["/camera/image_raw"], kept.len() as u64);
    assert!(repaired.tear.unwrap().at <= torn.len() as u64);
    assert_eq!(fs::read(&path).unwrap(), torn, "the original is kept");
    let again = fs::read(&repaired.path).unwrap();
    assert_eq!(messages(&again), (kept.clone(), false));
    assert_eq!(recording::metadata(&repaired.path, "nightflow").unwrap(), Some(settings()));

    let replaced = repair(&path, Original::Replace).unwrap();
    assert_eq!(replaced.path, path);
    assert_eq!(fs::read(&path).unwrap(), again);
    let left = repair(&path, Original::Replace).unwrap();
    assert!(left.tear.is_none() && left.messages == kept.len() as u64);
    assert_eq!(fs::read(&path).unwrap(), again);

    fs::write(&path, "no recording").unwrap();
    let said = repair(&path, Original::Keep).unwrap_err().to_string();
    assert!(said.contains("is no MCAP file"), "{said}");
}

const RECORD: &str = "NIGHTFLOW_TEST_RECORD";
const KILLED_SIZE: (u32, u32) = (64, 48);

/// What is recorded until the kill, item by item.
fn sequence() -> impl Iterator<Item = Result<Sample, u64>> {
    let (width, height) = KILLED_SIZE;
    let opening = [Ok(Sample::Info(info())), Ok(Sample::Range(range()))];
    opening.into_iter().chain((0..).flat_map(move |k| {
        let step = (k > 0).then(|| Err(u64::from(k) - 1));
        [Ok(Sample::Imu(imu(k))), Ok(Sample::Frame(frame(k, width, height)))].into_iter().chain(step)
    }))
}

/// Records for the test below in a process of its own, which prints what is safe; with no file given it is no test.
#[test]
fn in_another_process() {
    let Ok(role) = std::env::var(RECORD) else { return };
    let (compression, path) = role.split_once(' ').unwrap();
    let compression = match compression {
        "none" => Compression::None,
        "lz4" => Compression::Lz4,
        _ => Compression::Zstd,
    };
    let config = Config { path: Some(path.into()), compression, sync_s: 0.02, queue_max: 1000, ..Config::default() };
    let mut recorder =
        Recorder::open(&config, &camera::Config::default(), "/nightflow", "base_link", &settings()).unwrap();
    let mut told = 0;
    for item in sequence() {
        match item {
            Ok(sample) => recorder.sample(&sample).unwrap(),
            Err(step) => offer(&mut recorder, &moved(step, State::Ok), 0.0),
        }
        let synced = recorder.synced();
        if synced > told {
            println!("synced {synced}");
            told = synced;
        }
        std::thread::sleep(Duration::from_micros(300));
    }
}

/// Starts a recording, kills it `after` its first sync and gives the number of items that it called safe.
fn kill_while_recording(path: &Path, compression: &str, after: Duration) -> usize {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "torn::in_another_process", "--nocapture"])
        .env(RECORD, format!("{compression} {}", path.display()))
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let synced = |line: String| line.strip_prefix("synced ").map(|count| count.parse::<usize>().unwrap());
    let first = lines.by_ref().find_map(synced).expect("a first sync is told");
    std::thread::sleep(after);
    child.kill().unwrap();
    child.wait().unwrap();
    lines.filter_map(synced).last().unwrap_or(first)
}

#[test]
fn twenty_kills_cost_at_most_the_last_interval() {
    let folder = tempfile::tempdir().unwrap();
    // Seeded: the same moments in every run.
    let mut seed = 0x6e69_6768_7466_6c77_u64;
    let mut torn = 0;
    for round in 0..20 {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        let path = folder.path().join(format!("{round}.mcap"));
        let compression = ["none", "lz4", "zstd"][round % 3];
        let safe = kill_while_recording(&path, compression, Duration::from_micros(seed % 200_000));

        let repaired = repair(&path, Original::Keep).unwrap();
        torn += usize::from(repaired.tear.is_some());
        assert!(repair(&repaired.path, Original::Keep).unwrap().tear.is_none(), "what was repaired is whole");
        // Every item up to the last sync is there, and whatever else is there goes on from it.
        let expected: Vec<_> = sequence().take(safe).collect();
        let wanted: Vec<Sample> = expected.iter().filter_map(|item| item.clone().ok()).collect();
        let samples = read(&repaired.path, &camera::Config::default());
        assert!(
            samples.len() >= wanted.len(),
            "round {round}: {} samples of {} that were safe",
            samples.len(),
            wanted.len()
        );
        let all: Vec<Sample> = sequence().filter_map(Result::ok).take(samples.len()).collect();
        assert!(samples == all, "round {round}: the samples are not those that were recorded");
        let steps: Vec<Stamp> = Outputs::open(&repaired.path, "/nightflow")
            .unwrap()
            .filter(|output| output.topic == "/nightflow/step")
            .map(|output| output.stamp)
            .collect();
        let wanted = expected.iter().filter(|item| item.is_err()).count();
        assert!(steps.len() >= wanted, "round {round}: {} steps of {wanted}", steps.len());
        assert!(steps.iter().enumerate().all(|(step, stamp)| *stamp == moved(step as u64, State::Ok).newer));
        assert_eq!(recording::metadata(&repaired.path, "nightflow").unwrap(), Some(settings()));
        if round < 3 {
            let printed = peers::run("mcap_read.py", [&repaired.path]);
            assert!(printed.contains(&format!("rosbags {}", repaired.messages)), "round {round}");
        }
    }
    assert_eq!(torn, 20, "a killed recorder leaves no footer");
}
