//! Frames for the dark data set: a binary PPM is darkened where it lies in memory, anything else is decoded first.

use std::{fs::File, io::Read, path::Path};

use super::super::flow_files::{self, Flaw};

/// A frame as the bytes of a PPM file.
pub(super) struct Frame<'a> {
    /// Columns and rows.
    pub size: [usize; 2],
    bytes: &'a mut Vec<u8>,
    header: usize,
}

impl<'a> Frame<'a> {
    /// Reads a frame into `bytes`.
    pub fn read(path: &Path, bytes: &'a mut Vec<u8>) -> Result<Self, flow_files::Error> {
        let io = |source| flow_files::Error::Io { path: path.into(), source };
        bytes.clear();
        let mut file = File::open(path).map_err(io)?;
        bytes.reserve(file.metadata().map_err(io)?.len() as usize + 1);
        file.read_to_end(bytes).map_err(io)?;
        let content = |flaw| flow_files::Error::Content { path: path.into(), flaw };
        let Some((size, begin)) = plain(bytes) else {
            let picture = flow_files::parse_frame(bytes).map_err(content)?;
            let size = [picture.width() as usize, picture.height() as usize];
            *bytes = header(size);
            let header = bytes.len();
            bytes.extend_from_slice(picture.as_raw());
            return Ok(Self { size, bytes, header });
        };
        let expected = size[0].saturating_mul(size[1]).saturating_mul(3).saturating_add(begin);
        if bytes.len() < expected {
            return Err(content(Flaw::Length { expected: expected as u64, found: bytes.len() as u64 }));
        }
        bytes.truncate(expected);
        let header = header(size);
        let length = header.len();
        bytes.splice(..begin, header);
        Ok(Self { size, bytes, header: length })
    }

    /// Interleaved red, green, blue.
    pub fn pixels(&mut self) -> &mut [u8] {
        &mut self.bytes[self.header..]
    }

    /// The whole file.
    pub fn bytes(&self) -> &[u8] {
        self.bytes
    }
}

fn header([width, height]: [usize; 2]) -> Vec<u8> {
    format!("P6\n{width} {height}\n255\n").into_bytes()
}

/// Size and first pixel of a binary PPM of 8 bits; `None` of every other picture.
fn plain(bytes: &[u8]) -> Option<([usize; 2], usize)> {
    let mut at = bytes.strip_prefix(b"P6").map(|_| 2)?;
    let mut numbers = [0; 3];
    for number in &mut numbers {
        at = after_space(bytes, at)?;
        let digits = bytes[at..].iter().take_while(|byte| byte.is_ascii_digit()).count();
        *number = std::str::from_utf8(&bytes[at..at + digits]).ok()?.parse().ok()?;
        at += digits;
    }
    let [width, height, white] = numbers;
    (bytes.get(at)?.is_ascii_whitespace() && width > 0 && height > 0 && white == 255)
        .then_some(([width, height], at + 1))
}

/// The first place behind white space and comments, of which there must be some.
fn after_space(bytes: &[u8], from: usize) -> Option<usize> {
    let mut at = from;
    loop {
        match bytes.get(at)? {
            b'#' => at += bytes[at..].iter().position(|byte| *byte == b'\n')?,
            byte if byte.is_ascii_whitespace() => at += 1,
            _ => return (at > from).then_some(at),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_are_read_as_the_format_has_them() {
        assert_eq!(plain(b"P6\n512 384\n255\nabc"), Some(([512, 384], 15)));
        assert_eq!(plain(b"P6 # a chair\n# by hand\n2\t1 255 abcdef"), Some(([2, 1], 31)));
        let others: [&[u8]; 8] = [
            b"P5\n2 1\n255\n",
            b"P6\n2 1\n65535\n",
            b"P6",
            b"P62 1 255\n",
            b"P6\n2 x 255\n",
            b"P6\n2 1 255",
            b"P6\n# 2 1",
            b"P6\n0 1 255\n",
        ];
        for other in others {
            assert_eq!(plain(other), None, "{}", String::from_utf8_lossy(other));
        }
    }
}
