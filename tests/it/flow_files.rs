//! Flow files: what is written is read again, by us and by OpenCV, and nothing that is broken gets through.

use std::path::Path;

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use nightflow::darkness::flow_files::{
    self, Field, Flaw, flo_bytes, kitti_bytes, parse_flo, parse_frame, parse_kitti, read_frame, write_picture,
};
use proptest::prelude::*;

use crate::peers;

/// A field of any size whose vectors fit into a KITTI file; some are unknown.
fn fields() -> impl Strategy<Value = Field> {
    (1..24_usize, 1..24_usize).prop_flat_map(|(width, height)| {
        let vector = (-511.9..511.9_f32, -511.9..511.9_f32, prop::bool::weighted(0.8));
        prop::collection::vec(vector, width * height).prop_map(move |drawn| {
            let known: Vec<bool> = drawn.iter().map(|(_, _, known)| *known).collect();
            let vectors = drawn.iter().map(|(u, v, known)| if *known { [*u, *v] } else { [f32::NAN; 2] }).collect();
            Field { width, height, vectors, valid: known.contains(&false).then_some(known) }
        })
    })
}

fn same(a: &Field, b: &Field, tolerance: f64) -> bool {
    (a.width, a.height) == (b.width, b.height)
        && (0..a.vectors.len()).all(|i| {
            a.known(i) == b.known(i)
                && (!a.known(i) || (0..2).all(|c| f64::from(a.vectors[i][c] - b.vectors[i][c]).abs() <= tolerance))
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn what_is_written_is_read_again(field in fields()) {
        let again = parse_flo(&flo_bytes(&field).unwrap()).unwrap();
        prop_assert!(same(&field, &again, 0.0));
        prop_assert_eq!(field.valid.is_some(), again.valid.is_some());
        let again = parse_kitti(&kitti_bytes(&field).unwrap()).unwrap();
        prop_assert!(same(&field, &again, 1.0 / 128.0));
    }

    #[test]
    fn a_torn_file_is_refused_and_never_panics(field in fields(), part in 0.0..1.0_f64, extra in 1..9_usize) {
        let torn = |whole: &[u8], most: usize| whole[..(most as f64 * part) as usize].to_vec();
        let flo = flo_bytes(&field).unwrap();
        prop_assert!(parse_flo(&torn(&flo, flo.len())).is_err());
        // Behind a PNG's pixels stand 24 bytes of sums and of its end mark, without which they are whole all the same.
        let kitti = kitti_bytes(&field).unwrap();
        prop_assert!(parse_kitti(&torn(&kitti, kitti.len() - 24)).is_err());
        let mut long = flo;
        let right = long.len() as u64;
        long.resize(long.len() + extra, 0);
        prop_assert_eq!(parse_flo(&long), Err(Flaw::Length { expected: right, found: right + extra as u64 }));
    }

    #[test]
    fn any_bytes_are_refused_or_read_and_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), mark in 0..4) {
        let mark: &[u8] = [b"PIEH\x03\0\0\0\x02\0\0\0".as_slice(), b"\x89PNG\r\n\x1a\n", b"P6\n", b""][mark as usize];
        let bytes = [mark, &bytes].concat();
        let _ = (parse_flo(&bytes), parse_kitti(&bytes), parse_frame(&bytes));
    }
}

#[test]
fn refusals_say_what_was_expected_and_what_was_found() {
    let header =
        |width: i32, height: i32| [202_021.25_f32.to_le_bytes(), width.to_le_bytes(), height.to_le_bytes()].concat();
    let said = |bytes: &[u8]| parse_flo(bytes).unwrap_err().to_string();
    assert_eq!(said(b"RIFFxxxxxxxx"), "expected 202021.25 (\"PIEH\") at the beginning, found \"RIFF\"");
    assert_eq!(said(b"PI"), "expected 12 bytes, found 2");
    assert_eq!(said(&header(3, 2)), "expected 60 bytes, found 12");
    for (width, height) in [(0, 5), (-1, 5), (70_000, 1), (60_000, 60_000), (i32::MIN, i32::MAX)] {
        let expected = Flaw::Size { width: width.into(), height: height.into() };
        assert_eq!(parse_flo(&header(width, height)), Err(expected));
    }
    // A header that promises two gigabytes in a file of a few bytes is refused by its length alone.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("huge.flo");
    std::fs::write(&path, header(16_384, 16_384)).unwrap();
    let said = flow_files::read(&path).unwrap_err().to_string();
    assert!(said.ends_with("huge.flo: expected 2147483660 bytes, found 12"), "{said}");
    let said = flow_files::read(Path::new("flow.exr")).unwrap_err().to_string();
    assert_eq!(said, "flow.exr: expected a name that ends in .flo or .png, found \"exr\"");
    let missing = flow_files::read(&folder.path().join("none.flo")).unwrap_err();
    assert!(matches!(missing, flow_files::Error::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound));
}

#[test]
fn unknown_and_senseless_vectors_are_not_known() {
    let mut bytes = [202_021.25_f32.to_le_bytes(), 4_i32.to_le_bytes(), 1_i32.to_le_bytes()].concat();
    for value in [1.5, -2.5, 1e10, 0.0, f32::NAN, 0.0, 0.0, f32::NEG_INFINITY] {
        bytes.extend(f32::to_le_bytes(value));
    }
    let field = parse_flo(&bytes).unwrap();
    assert_eq!(field.valid, Some(vec![true, false, false, false]));
    assert_eq!((field.at(0, 0), field.at(1, 0), field.at(4, 0), field.at(0, 1)), (Some([1.5, -2.5]), None, None, None));
    assert_eq!(field.longest(), 1.5_f32.hypot(2.5));
    let own = Field { width: 4, height: 1, vectors: vec![[4.5, 1.5]; 4], valid: None };
    assert_eq!(own.errors(&field), Some(vec![Some(5.0), None, None, None]));
    assert_eq!(field.errors(&own).unwrap()[1..], [Some(f32::INFINITY); 3]);
    assert_eq!(own.errors(&Field::new(2, 2, vec![[0.0; 2]; 4]).unwrap()), None);
}

#[test]
fn what_does_not_fit_the_format_is_not_written() {
    let field = Field::new(2, 1, vec![[0.0, 0.0], [0.0, 512.0]]).unwrap();
    let refused = Err(Flaw::Vector { u: 0.0, v: 512.0, column: 1, row: 0 });
    assert_eq!(kitti_bytes(&field), refused);
    assert!(kitti_bytes(&Field::new(1, 1, vec![[-512.0, 511.98]]).unwrap()).is_ok());
    let count = Flaw::Count { what: "vectors", expected: 4, found: 1, width: 2, height: 2 };
    assert_eq!(Field::new(2, 2, vec![[0.0; 2]]), Err(count));
    let short = Field { width: 2, height: 1, vectors: vec![[0.0; 2]; 2], valid: Some(vec![true]) };
    assert!(matches!(flo_bytes(&short), Err(Flaw::Count { what: "marks of validity", found: 1, .. })));
}

fn png(width: u32, height: u32, kind: ExtendedColorType, bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    PngEncoder::new(&mut out).write_image(bytes, width, height, kind).unwrap();
    out
}

#[test]
fn other_pictures_are_no_kitti_flow_and_bombs_are_none_at_all() {
    let eight = png(2, 1, ExtendedColorType::Rgb8, &[0; 6]);
    let said = parse_kitti(&eight).unwrap_err().to_string();
    assert_eq!(said, "expected three channels of 16 bits, found Rgb8");
    assert!(matches!(parse_kitti(b"P6\n2 1\n255\n"), Err(Flaw::Magic { .. })));
    // The header says 16000×16000 and the content is two pixels; the check of the header's own sum is renewed.
    let mut bomb = png(2, 1, ExtendedColorType::Rgb16, &[0; 12]);
    bomb[16..24].copy_from_slice(&[0, 0, 0x3e, 0x80, 0, 0, 0x3e, 0x80]);
    let sum = crc(&bomb[12..29]);
    bomb[29..33].copy_from_slice(&sum.to_be_bytes());
    assert!(
        matches!(parse_kitti(&bomb), Err(Flaw::Thin { width: 16_000, height: 16_000, .. })),
        "{:?}",
        parse_kitti(&bomb)
    );
    assert!(matches!(parse_frame(&bomb), Err(Flaw::Thin { .. })));
    assert!(matches!(parse_frame(b"P6 16000 16000 255\n1234"), Err(Flaw::Thin { .. })));
    assert!(matches!(parse_frame(b"nothing"), Err(Flaw::Magic { .. })));
}

/// The sum that PNG keeps behind each chunk.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 })
    })
}

#[test]
fn frames_and_pictures_of_flow_are_what_was_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("frame.ppm"), b"P6\n2 1\n255\n\x01\x02\x03\xfd\xfe\xff").unwrap();
    assert_eq!(read_frame(&at("frame.ppm")).unwrap().into_raw(), [1, 2, 3, 253, 254, 255]);
    std::fs::write(at("frame.png"), png(1, 1, ExtendedColorType::Rgba8, &[9, 8, 7, 0])).unwrap();
    assert_eq!(read_frame(&at("frame.png")).unwrap().into_raw(), [9, 8, 7]);
    let vectors = vec![[4.0, 0.0], [0.0, 0.0], [f32::NAN, 0.0]];
    write_picture(&at("wheel.png"), &Field::new(3, 1, vectors).unwrap(), 4.0).unwrap();
    assert_eq!(read_frame(&at("wheel.png")).unwrap().into_raw(), [255, 0, 0, 255, 255, 255, 0, 0, 0]);
}

#[test]
fn opencv_reads_what_is_written_and_writes_what_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (width, height) = (37, 23);
    let valid: Vec<bool> = (0..width * height).map(|i| i % 7 != 3).collect();
    let vectors = (0..width * height).map(|i| [(i % width) as f32 * 0.37 - 6.0, (i / width) as f32 * -1.61 + 9.0]);
    let field = Field { width, height, vectors: vectors.collect(), valid: Some(valid) };
    flow_files::write(&at("ours.flo"), &field).unwrap();
    flow_files::write(&at("ours.png"), &field).unwrap();
    let said = peers::run("flow_files.py", [folder.path()]);
    let known: Vec<usize> = (0..width * height).filter(|i| field.known(*i)).collect();
    let sum: f64 = known.iter().flat_map(|i| field.vectors[*i]).map(f64::from).sum();
    assert_eq!(said.trim(), format!("{width} {height} {} {sum:.3}", known.len()));
    assert!(same(&field, &flow_files::read(&at("theirs.flo")).unwrap(), 0.0));
    assert!(same(&field, &flow_files::read(&at("theirs.png")).unwrap(), 1.0 / 128.0));
}
