//! Finds the first value in which two CDR messages differ, and names it by the `.msg` text that they were written with.

use std::fmt::Display;

use crate::wire::{
    Definitions,
    definition::{Base, Count},
};

/// Messages nest by their definitions; a text that makes them nest deeper is no message.
const DEPTH_MAX: usize = 16;

/// Names the first value that differs, as in `twist.covariance[7] 0.1 ≠ 0.2`; `None` when the bytes are equal.
///
/// `definition` is the message's own name, `geometry_msgs/msg/Twist`, and `text` its definition with dependencies.
pub(super) fn first_difference(definition: &str, text: &str, recorded: &[u8], replayed: &[u8]) -> Option<String> {
    if recorded == replayed {
        return None;
    }
    let mut definitions = Definitions::default();
    // A text that can't be read leaves the message without its definition, and the difference without a name.
    let _ = definitions.insert_schema(definition, text);
    let mut walk = Walk { definitions: &definitions, recorded: Cdr::new(recorded), replayed: Cdr::new(replayed) };
    let named = match walk.message(definition, "", 0) {
        Err(End::Differs(said)) => Some(said),
        Ok(()) | Err(End::Lost) => None,
    };
    // Bytes that no field covers, or a text that does not fit them.
    Some(named.unwrap_or_else(|| {
        let at = recorded.iter().zip(replayed).take_while(|(a, b)| a == b).count();
        match (recorded.get(at), replayed.get(at)) {
            (Some(a), Some(b)) => format!("byte {at} {a:#04x} ≠ {b:#04x}"),
            _ => format!("length {} ≠ {}", recorded.len(), replayed.len()),
        }
    }))
}

/// Why a walk stops.
enum End {
    /// A value differs.
    Differs(String),
    /// The definition does not fit the bytes.
    Lost,
}

struct Walk<'d, 'b> {
    definitions: &'d Definitions,
    recorded: Cdr<'b>,
    replayed: Cdr<'b>,
}

impl Walk<'_, '_> {
    fn message(&mut self, name: &str, path: &str, depth: usize) -> Result<(), End> {
        let fields = self.definitions.get(name).filter(|_| depth < DEPTH_MAX).ok_or(End::Lost)?;
        for field in &fields.fields {
            let dot = if path.is_empty() { "" } else { "." };
            let path = format!("{path}{dot}{}", field.name);
            let count = match field.count {
                Count::One => {
                    self.value(&field.base, &path, depth)?;
                    continue;
                }
                Count::Array(count) => count as usize,
                Count::UpTo(_) | Count::Any => self.length(&path)?,
            };
            if matches!(field.base, Base::Uint8 | Base::Byte) {
                self.bytes(count, &path)?;
            } else {
                for index in 0..count {
                    self.value(&field.base, &format!("{path}[{index}]"), depth)?;
                }
            }
        }
        Ok(())
    }

    fn length(&mut self, path: &str) -> Result<usize, End> {
        let (a, b) = (self.recorded.four()?, self.replayed.four()?);
        let (a, b) = (u32::from_le_bytes(a), u32::from_le_bytes(b));
        same(&format!("{path}.length"), a, b, a == b)?;
        Ok(a as usize)
    }

    fn bytes(&mut self, count: usize, path: &str) -> Result<(), End> {
        let (a, b) = (self.recorded.take(count)?, self.replayed.take(count)?);
        match a.iter().zip(b).position(|(a, b)| a != b) {
            Some(at) => same(&format!("{path}[{at}]"), a[at], b[at], false),
            None => Ok(()),
        }
    }

    fn value(&mut self, base: &Base, path: &str, depth: usize) -> Result<(), End> {
        let (a, b) = (&mut self.recorded, &mut self.replayed);
        macro_rules! number {
            ($kind:ty, $read:ident) => {{
                let (a, b) = (a.$read()?, b.$read()?);
                same(path, <$kind>::from_le_bytes(a), <$kind>::from_le_bytes(b), a == b)
            }};
        }
        match base {
            Base::Bool | Base::Byte | Base::Uint8 => number!(u8, one),
            Base::Int8 => number!(i8, one),
            Base::Uint16 => number!(u16, two),
            Base::Int16 => number!(i16, two),
            Base::Uint32 => number!(u32, four),
            Base::Int32 => number!(i32, four),
            Base::Uint64 => number!(u64, eight),
            Base::Int64 => number!(i64, eight),
            Base::Float32 => number!(f32, four),
            Base::Float64 => number!(f64, eight),
            Base::String(_) => {
                let (a, b) = (a.text()?, b.text()?);
                let shown = |text| String::from_utf8_lossy(text).into_owned();
                same(path, format!("{:?}", shown(a)), format!("{:?}", shown(b)), a == b)
            }
            // No message here has one, and its form differs between the middlewares.
            Base::Wstring(_) => Err(End::Lost),
            Base::Message(nested) => self.message(nested, path, depth + 1),
        }
    }
}

fn same(path: &str, recorded: impl Display, replayed: impl Display, same: bool) -> Result<(), End> {
    if same { Ok(()) } else { Err(End::Differs(format!("{path} {recorded} ≠ {replayed}"))) }
}

/// Little-endian CDR, aligned from behind its four bytes of encapsulation.
struct Cdr<'b> {
    body: &'b [u8],
    at: usize,
}

impl<'b> Cdr<'b> {
    fn new(bytes: &'b [u8]) -> Self {
        Self { body: bytes.get(4..).unwrap_or_default(), at: 0 }
    }

    fn take(&mut self, count: usize) -> Result<&'b [u8], End> {
        let taken = self.at.checked_add(count).and_then(|end| self.body.get(self.at..end)).ok_or(End::Lost)?;
        self.at += count;
        Ok(taken)
    }

    fn aligned<const N: usize>(&mut self) -> Result<[u8; N], End> {
        self.at = self.at.next_multiple_of(N);
        self.take(N)?.try_into().map_err(|_| End::Lost)
    }

    fn one(&mut self) -> Result<[u8; 1], End> {
        self.aligned()
    }

    fn two(&mut self) -> Result<[u8; 2], End> {
        self.aligned()
    }

    fn four(&mut self) -> Result<[u8; 4], End> {
        self.aligned()
    }

    fn eight(&mut self) -> Result<[u8; 8], End> {
        self.aligned()
    }

    fn text(&mut self) -> Result<&'b [u8], End> {
        let length = u32::from_le_bytes(self.four()?) as usize;
        let text = self.take(length)?;
        Ok(text.strip_suffix(&[0]).unwrap_or(text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "\
# a pose
uint8 OK=0   # constant
std_msgs/Header header
Inner[2] inner
string<=8 note
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: test_msgs/Inner
float64 value
";

    fn message(value: f64, note: &str, data: &[u8]) -> Vec<u8> {
        let mut cdr = vec![0, 1, 0, 0];
        cdr.extend(7i32.to_le_bytes());
        cdr.extend(8u32.to_le_bytes());
        cdr.extend(2u32.to_le_bytes());
        cdr.extend(b"a\0");
        cdr.extend([0; 2]);
        cdr.extend(1.5f64.to_le_bytes());
        cdr.extend(value.to_le_bytes());
        cdr.extend((note.len() as u32 + 1).to_le_bytes());
        cdr.extend(note.as_bytes());
        cdr.push(0);
        cdr.resize(cdr.len().next_multiple_of(4), 0);
        cdr.extend((data.len() as u32).to_le_bytes());
        cdr.extend(data);
        cdr
    }

    fn difference(a: &[u8], b: &[u8]) -> Option<String> {
        first_difference("test_msgs/msg/Pose", TEXT, a, b)
    }

    #[test]
    fn the_first_difference_has_its_name_and_both_values() {
        let one = message(2.5, "hi", &[1, 2, 3]);
        assert_eq!(difference(&one, &one), None);
        let said = |other: Vec<u8>| difference(&one, &other).unwrap();
        assert_eq!(said(message(0.1, "hi", &[1, 2, 3])), "inner[1].value 2.5 ≠ 0.1");
        assert_eq!(said(message(2.5, "ho", &[1, 2, 3])), "note \"hi\" ≠ \"ho\"");
        assert_eq!(said(message(2.5, "hi", &[1, 2, 4])), "data[2] 3 ≠ 4");
        assert_eq!(said(message(2.5, "hi", &[1, 2])), "data.length 3 ≠ 2");
        let mut stamp = one.clone();
        stamp[4] = 9;
        assert_eq!(said(stamp), "header.stamp.sec 7 ≠ 9");
    }

    #[test]
    fn bytes_that_fit_no_definition_are_named_by_their_place() {
        let one = message(2.5, "hi", &[1, 2, 3]);
        assert_eq!(
            first_difference("test_msgs/msg/Pose", "", &one, &one[..30]).unwrap(),
            format!("length {} ≠ 30", one.len())
        );
        let mut padding = one.clone();
        padding[4 + 14] = 1;
        assert_eq!(difference(&one, &padding).unwrap(), "byte 18 0x00 ≠ 0x01");
    }
}
