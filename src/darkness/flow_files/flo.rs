//! Middlebury `.flo`: 202021.25, width, height, then (u, v) row by row, all little-endian and four bytes wide.

use std::io::{self, Read};

use super::{Field, Flaw, checked_size};

const MAGIC: f32 = 202_021.25;
const HEADER: usize = 12;
/// A longer component means that the vector is unknown, as the benchmark has it.
const UNKNOWN_FROM: f32 = 1e9;
/// What the benchmark writes where the vector is unknown.
const UNKNOWN: f32 = 1e10;

/// Reads the bytes of a `.flo` file; vectors beyond 1e9 or not finite are unknown.
pub fn parse_flo(bytes: &[u8]) -> Result<Field, Flaw> {
    let (width, height) = size(bytes)?;
    let expected = length(width, height);
    if bytes.len() as u64 != expected {
        return Err(Flaw::Length { expected, found: bytes.len() as u64 });
    }
    let (pairs, _) = bytes[HEADER..].as_chunks::<8>();
    Ok(Field::of(
        width,
        height,
        pairs.iter().map(|[a, b, c, d, e, f, g, h]| {
            let vector = [f32::from_le_bytes([*a, *b, *c, *d]), f32::from_le_bytes([*e, *f, *g, *h])];
            vector.iter().all(|value| value.abs() <= UNKNOWN_FROM).then_some(vector)
        }),
    ))
}

/// Reads no more than the header allows, and no memory is asked for that bytes have not filled.
pub(super) fn read_flo(mut file: impl Read) -> io::Result<Result<Field, Flaw>> {
    let mut bytes = Vec::new();
    file.by_ref().take(HEADER as u64).read_to_end(&mut bytes)?;
    match size(&bytes) {
        Ok((width, height)) => {
            // One byte more than is right shows that there is too much.
            file.take(length(width, height) - HEADER as u64 + 1).read_to_end(&mut bytes)?;
            Ok(parse_flo(&bytes))
        }
        Err(flaw) => Ok(Err(flaw)),
    }
}

/// The field as a `.flo` file; what is unknown becomes 1e10.
pub fn flo_bytes(field: &Field) -> Result<Vec<u8>, Flaw> {
    field.check()?;
    let mut bytes = Vec::with_capacity(length(field.width, field.height) as usize);
    bytes.extend(MAGIC.to_le_bytes());
    bytes.extend((field.width as i32).to_le_bytes());
    bytes.extend((field.height as i32).to_le_bytes());
    for (index, vector) in field.vectors.iter().enumerate() {
        let [u, v] = if field.known(index) { *vector } else { [UNKNOWN; 2] };
        bytes.extend(u.to_le_bytes());
        bytes.extend(v.to_le_bytes());
    }
    Ok(bytes)
}

fn length(width: usize, height: usize) -> u64 {
    HEADER as u64 + 8 * width as u64 * height as u64
}

fn size(bytes: &[u8]) -> Result<(usize, usize), Flaw> {
    let four = |at: usize| bytes.get(at..at + 4).and_then(|four| <[u8; 4]>::try_from(four).ok());
    if let Some(magic) = four(0).filter(|magic| f32::from_le_bytes(*magic) != MAGIC) {
        let found = format!("{:?}", String::from_utf8_lossy(&magic));
        return Err(Flaw::Magic { expected: "202021.25 (\"PIEH\")", found });
    }
    match (four(0), four(4), four(8)) {
        (Some(_), Some(width), Some(height)) => {
            checked_size(i32::from_le_bytes(width).into(), i32::from_le_bytes(height).into())
        }
        _ => Err(Flaw::Length { expected: HEADER as u64, found: bytes.len() as u64 }),
    }
}
