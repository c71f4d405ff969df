//! `nightflow synth fcdn` on a folder: the same bytes by any number of threads and after a kill; what is torn is named.

use std::{
    collections::BTreeMap,
    fs,
    path::Path,
    process::{Command, Output, Stdio},
    time::Duration,
};

const SIZE: [usize; 2] = [96, 64];

/// A frame of soft stripes and blocks, different for every pair.
fn frame(seed: usize) -> Vec<u8> {
    let pixel = |at: usize| {
        let (x, y) = (at % SIZE[0], at / SIZE[0]);
        [x * 2 + seed * 11, y * 3 + (x / 16 * 40 + seed * 7) % 90, (x + y + seed * 29) % 200]
            .map(|value| (value % 256) as u8)
    };
    (0..SIZE[0] * SIZE[1]).flat_map(pixel).collect()
}

fn ppm(seed: usize) -> Vec<u8> {
    [format!("P6\n{} {}\n255\n", SIZE[0], SIZE[1]).into_bytes(), frame(seed)].concat()
}

fn flow(seed: usize) -> Vec<u8> {
    let mut bytes = b"PIEH".to_vec();
    bytes.extend(SIZE.iter().flat_map(|side| (*side as i32).to_le_bytes()));
    bytes.extend((0..2 * SIZE[0] * SIZE[1]).flat_map(|at| ((at + seed) as f32 * 0.01).to_le_bytes()));
    bytes
}

fn clean(folder: &Path, pairs: usize) {
    fs::create_dir_all(folder).unwrap();
    for number in 1..=pairs {
        let write = |part: &str, bytes: Vec<u8>| fs::write(folder.join(format!("{number:05}_{part}")), bytes).unwrap();
        write("img1.ppm", ppm(2 * number));
        write("img2.ppm", ppm(2 * number + 1));
        write("flow.flo", flow(number));
    }
}

fn synth(from: &Path, to: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_nightflow"));
    command.args(["synth", "fcdn", "--from"]).arg(from).arg("--to").arg(to).args(more);
    command
}

/// Ends with this code; what it printed.
fn ends(mut command: Command, code: i32) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let printed = format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert_eq!(status.code(), Some(code), "{printed}");
    printed
}

/// Every file by its name.
fn content(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let file = |entry: fs::DirEntry| (entry.file_name().into_string().unwrap(), fs::read(entry.path()).unwrap());
    fs::read_dir(folder).unwrap().map(|entry| file(entry.unwrap())).collect()
}

fn assert_same(left: &Path, right: &Path) {
    let (left, right) = (content(left), content(right));
    assert_eq!(left.keys().collect::<Vec<_>>(), right.keys().collect::<Vec<_>>());
    for (name, bytes) in &left {
        assert!(*bytes == right[name], "{name} differs");
    }
}

#[test]
fn a_set_is_the_same_by_any_number_of_threads() {
    let home = tempfile::tempdir().unwrap();
    let from = home.path().join("clean");
    clean(&from, 24);
    for recipe in ["paper", "authors-2021", "unprocess"] {
        let [one, two] = ["1", "2"].map(|threads| {
            let to = home.path().join(format!("{recipe}-{threads}"));
            let said = ends(synth(&from, &to, &["--recipe", recipe, "--seed", "5", "--threads", threads]), 0);
            assert!(said.contains("24 pairs made, 0 were there, 0 skipped"), "{said}");
            to
        });
        assert_same(&one, &two);
        let made = content(&one);
        assert_eq!(made.len(), 3 * 24 + 2);
        for number in 1..=24 {
            assert!(made[&format!("{number:05}_flow.flo")] == flow(number), "the flow is copied byte for byte");
            for (part, seed) in [("img1", 2 * number), ("img2", 2 * number + 1)] {
                let frame = &made[&format!("{number:05}_{part}.ppm")];
                assert_eq!((frame.len(), &frame[..13]), (ppm(seed).len(), &b"P6\n96 64\n255\n"[..]));
                assert!(*frame != ppm(seed), "{recipe}: {number} is as clean as it was");
            }
        }
        let table = String::from_utf8(made["fcdn.csv"].clone()).unwrap();
        let rows: Vec<&str> = table.lines().collect();
        assert_eq!(rows.len(), 25);
        assert!(rows[0].starts_with("pair,level,a_red,") && rows[7].starts_with("00007,"), "{table}");
        assert!(rows.iter().all(|row| row.split(',').count() == 17), "{table}");
        assert_eq!(
            rows[1].ends_with(",,"),
            recipe != "paper",
            "a camera is drawn by the paper's recipe alone: {table}"
        );
    }
    let other = home.path().join("other");
    ends(synth(&from, &other, &["--seed", "6"]), 0);
    let seeds = [content(&home.path().join("paper-1")), content(&other)];
    assert!(seeds[0]["00001_img1.ppm"] != seeds[1]["00001_img1.ppm"], "another seed is another noise");
}

#[test]
fn a_run_that_was_killed_goes_on_to_the_same_bytes() {
    let home = tempfile::tempdir().unwrap();
    let [from, at_once, killed] = ["clean", "at_once", "killed"].map(|name| home.path().join(name));
    let pairs = 600;
    clean(&from, pairs);
    ends(synth(&from, &at_once, &[]), 0);
    let expected = content(&at_once);
    let mut cut_short = 0;
    for most in [1, 40, 150] {
        let mut run = synth(&from, &killed, &["--threads", "2"]);
        let mut run = run.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let rows = |folder: &Path| fs::read_to_string(folder.join("fcdn.csv")).map_or(0, |text| text.lines().count());
        while rows(&killed) <= most && run.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_micros(200));
        }
        run.kill().unwrap();
        run.wait().unwrap();
        let left = content(&killed);
        cut_short += usize::from(left.len() < expected.len());
        // Whatever has its own name is whole.
        for (name, bytes) in left.iter().filter(|(name, _)| name.ends_with(".ppm") || name.ends_with(".flo")) {
            assert!(*bytes == expected[name], "{name} is torn");
        }
    }
    assert!(cut_short > 0, "no run was killed before its end");
    // The row of one pair is torn, the file of another is gone.
    let table = fs::read_to_string(killed.join("fcdn.csv")).unwrap();
    fs::write(killed.join("fcdn.csv"), &table[..table.len() - 7]).unwrap();
    let _ = fs::remove_file(killed.join("00001_img2.ppm"));
    let said = ends(synth(&from, &killed, &[]), 0);
    assert!(!said.contains(" 0 were there"), "the finished pairs are kept: {said}");
    assert_same(&at_once, &killed);
    let said = ends(synth(&from, &killed, &[]), 0);
    assert!(said.contains(&format!("0 pairs made, {pairs} were there")), "{said}");
}

#[test]
fn what_is_missing_or_torn_is_named_and_skipped() {
    let home = tempfile::tempdir().unwrap();
    let [from, to] = ["clean", "dark"].map(|name| home.path().join(name));
    clean(&from, 8);
    let at = |name: &str| from.join(name);
    fs::remove_file(at("00001_flow.flo")).unwrap();
    fs::remove_file(at("00002_img2.ppm")).unwrap();
    fs::write(at("00003_img1.ppm"), &ppm(3)[..5000]).unwrap();
    fs::write(at("00004_flow.flo"), &flow(4)[..5000]).unwrap();
    fs::write(at("00005_img2.ppm"), b"P6\n32 32\n255\n".iter().copied().chain([9; 3072]).collect::<Vec<u8>>()).unwrap();
    fs::write(at("00006_img1.ppm"), b"").unwrap();
    // Other kinds of pictures, and a name that is no number.
    let [picture, same] = [40, 41].map(|seed| image::RgbImage::from_raw(96, 64, frame(seed)).unwrap());
    picture.save(at("chairs_img1.png")).unwrap();
    same.save(at("chairs_img2.jpg")).unwrap();
    fs::write(at("chairs_flow.flo"), flow(40)).unwrap();
    fs::write(at("readme.txt"), "nothing").unwrap();
    let said = ends(synth(&from, &to, &[]), 0);
    for expected in [
        "pair 00001 has no 00001_flow.flo",
        "pair 00002 has no 00002_img2.ppm",
        "00003_img1.ppm: expected 18445 bytes, found 5000",
        "00004_flow.flo: expected the flow of 96×64 pixels in 49164 bytes, found 5000 bytes",
        "pair 00005: the frames have 96×64 and 32×32 pixels",
        "00006_img1.ppm",
        "3 pairs made, 0 were there, 6 skipped",
    ] {
        assert!(said.contains(expected), "{expected:?} is not in:\n{said}");
    }
    let names: Vec<String> = content(&to).into_keys().filter(|name| name.ends_with("img1.ppm")).collect();
    assert_eq!(names, ["00007_img1.ppm", "00008_img1.ppm", "chairs_img1.ppm"]);
    // The PNG gives what the PPM of the same pixels gives.
    fs::remove_file(at("chairs_img1.png")).unwrap();
    fs::write(at("chairs_img1.ppm"), ppm(40)).unwrap();
    let again = home.path().join("again");
    ends(synth(&from, &again, &[]), 0);
    assert!(content(&again)["chairs_img1.ppm"] == content(&to)["chairs_img1.ppm"]);
}

#[test]
fn what_makes_no_sense_is_refused_with_what_would() {
    let home = tempfile::tempdir().unwrap();
    let [from, to, empty] = ["clean", "dark", "empty"].map(|name| home.path().join(name));
    clean(&from, 2);
    fs::create_dir(&empty).unwrap();
    ends(synth(&from, &to, &["--seed", "3"]), 0);
    let said = ends(synth(&from, &to, &["--seed", "4"]), 2);
    assert!(
        said.contains("recipe paper, seed 3, version 1, and recipe paper, seed 4, version 1 is asked for"),
        "{said}"
    );
    let said = ends(synth(&from, &to, &["--seed", "3", "--recipe", "unprocess"]), 2);
    assert!(said.contains("recipe unprocess, seed 3"), "{said}");
    let said = ends(synth(&from, &from, &[]), 2);
    assert!(said.contains("holds the pair 00001 but no fcdn.toml"), "{said}");
    let said = ends(synth(&empty, &home.path().join("x"), &[]), 2);
    assert!(said.contains("holds no pair: expected NAME_img1.ppm"), "{said}");
    let said = ends(synth(&home.path().join("nowhere"), &to, &[]), 2);
    assert!(said.contains("nowhere"), "{said}");
    let said = ends(synth(&from, &to, &["--recipe", "brooks"]), 2);
    assert!(said.contains("there are paper, authors-2021 and unprocess"), "{said}");
    ends(synth(&from, &to, &["--threads", "0"]), 2);
    fs::remove_file(from.join("00001_img1.ppm")).unwrap();
    fs::write(from.join("00002_img1.ppm"), b"P6").unwrap();
    let said = ends(synth(&from, &home.path().join("y"), &[]), 2);
    assert!(said.contains("none of the 2 pairs"), "{said}");
}
