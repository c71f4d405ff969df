//! CDR in: XCDR version 1 of either byte order becomes one of our structs, and no length is believed before the bytes
//! that it counts are seen to be there.

use serde::{
    de::{self, DeserializeSeed, SeqAccess, Visitor},
    forward_to_deserialize_any,
};

/// What is wrong with the bytes. Boxed, since every number that is read passes through a `Result` of it.
#[derive(Debug)]
pub(super) struct Fault(pub Box<Report>);

/// The words of a [`Fault`]; `field` is the path from the message down.
#[derive(Debug)]
pub(super) struct Report {
    pub field: String,
    pub expected: String,
    pub found: String,
}

impl Fault {
    fn new(expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self(Box::new(Report { field: String::new(), expected: expected.into(), found: found.into() }))
    }

    fn within(mut self, outer: &str) -> Self {
        let field = &mut self.0.field;
        if !field.is_empty() {
            field.insert(0, '.');
        }
        field.insert_str(0, outer);
        self
    }
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: expected {}, found {}", self.0.field, self.0.expected, self.0.found)
    }
}

impl std::error::Error for Fault {}

impl de::Error for Fault {
    fn custom<T: std::fmt::Display>(message: T) -> Self {
        Self::new("a value of the field's type", message.to_string())
    }
}

/// RTPS fills a payload up to a multiple of four; anything longer is another message.
const PADDING: usize = 3;

/// Reads a value and sees to it that the bytes end with it.
pub(super) fn decode<T: de::DeserializeOwned>(bytes: &[u8]) -> Result<T, Fault> {
    let Some((header, body)) = bytes.split_first_chunk::<4>() else {
        return Err(Fault::new("an encapsulation header of 4 bytes", format!("{} bytes", bytes.len())));
    };
    // The last two bytes are options, which XCDR1 leaves to be ignored.
    let big_endian = match [header[0], header[1]] {
        [0, 0] => true,
        [0, 1] => false,
        [a, b] => {
            let expected = "plain XCDR1 (encapsulation 00 00 or 00 01)";
            return Err(Fault::new(expected, format!("encapsulation {a:02x} {b:02x}")));
        }
    };
    let mut decoder = Decoder { body, at: 0, big_endian };
    let value = T::deserialize(&mut decoder)?;
    let left = body.len() - decoder.at;
    if left > PADDING {
        return Err(Fault::new(format!("{} bytes", decoder.at + 4), format!("{} bytes", bytes.len())));
    }
    Ok(value)
}

struct Decoder<'de> {
    body: &'de [u8],
    at: usize,
    big_endian: bool,
}

impl<'de> Decoder<'de> {
    fn left(&self) -> usize {
        self.body.len() - self.at
    }

    fn align(&mut self, to: usize) {
        // Past the end is met by the read that follows.
        self.at = self.at.next_multiple_of(to).min(self.body.len());
    }

    fn take(&mut self, length: usize, what: &str) -> Result<&'de [u8], Fault> {
        let Some(taken) = self.body[self.at..].get(..length) else {
            return Err(self.torn(length, what));
        };
        self.at += length;
        Ok(taken)
    }

    #[cold]
    fn torn(&self, length: usize, what: &str) -> Fault {
        let found = format!("{} bytes before the end at byte {}", self.left(), self.body.len() + 4);
        Fault::new(format!("{length} bytes of {what}"), found)
    }

    fn number<const N: usize>(&mut self, what: &str) -> Result<[u8; N], Fault> {
        self.align(N);
        let mut number = [0; N];
        number.copy_from_slice(self.take(N, what)?);
        if self.big_endian {
            number.reverse();
        }
        Ok(number)
    }

    fn length(&mut self) -> Result<usize, Fault> {
        Ok(u32::from_le_bytes(self.number("a length")?) as usize)
    }

    fn text(&mut self) -> Result<&'de str, Fault> {
        let length = self.length()?;
        let bytes = self.take(length, "text")?;
        let text = match bytes.split_last() {
            Some((0, text)) => text,
            Some((last, _)) => {
                return Err(Fault::new("text that ends with a zero", format!("it ends with {last:#04x}")));
            }
            // Some writers give an empty text no zero.
            None => bytes,
        };
        std::str::from_utf8(text).map_err(|error| Fault::new("text in UTF-8", error.to_string()))
    }

    fn blob(&mut self) -> Result<&'de [u8], Fault> {
        let length = self.length()?;
        self.take(length, "a byte sequence")
    }
}

macro_rules! numbers {
    ($($method:ident $visit:ident $number:ident),*) => {$(
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
            visitor.$visit($number::from_le_bytes(self.number(stringify!($number))?))
        }
    )*};
}

impl<'de> de::Deserializer<'de> for &mut Decoder<'de> {
    type Error = Fault;

    numbers!(
        deserialize_i8 visit_i8 i8, deserialize_i16 visit_i16 i16,
        deserialize_i32 visit_i32 i32, deserialize_i64 visit_i64 i64,
        deserialize_u8 visit_u8 u8, deserialize_u16 visit_u16 u16,
        deserialize_u32 visit_u32 u32, deserialize_u64 visit_u64 u64,
        deserialize_f32 visit_f32 f32, deserialize_f64 visit_f64 f64
    );

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        match self.number("bool")? {
            [0] => visitor.visit_bool(false),
            [1] => visitor.visit_bool(true),
            [other] => Err(Fault::new("a bool, 0 or 1", other.to_string())),
        }
    }

    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_borrowed_str(self.text()?)
    }

    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_borrowed_str(self.text()?)
    }

    fn deserialize_bytes<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_borrowed_bytes(self.blob()?)
    }

    fn deserialize_byte_buf<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_byte_buf(self.blob()?.to_vec())
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Fault> {
        let length = self.length()?;
        // No element of a ROS 2 message is shorter than a byte.
        if length > self.left() {
            return Err(Fault::new(format!("{length} elements"), format!("{} bytes for them", self.left())));
        }
        visitor.visit_seq(Elements { decoder: self, left: length, names: &[] })
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, length: usize, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_seq(Elements { decoder: self, left: length, names: &[] })
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        names: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Fault> {
        visitor.visit_seq(Elements { decoder: self, left: names.len(), names })
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _name: &'static str, visitor: V) -> Result<V::Value, Fault> {
        visitor.visit_newtype_struct(self)
    }

    fn deserialize_any<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, Fault> {
        Err(Fault::new("a type that ROS 2 messages have", "one that they have not"))
    }

    forward_to_deserialize_any! {
        i128 u128 char option unit unit_struct tuple_struct map enum identifier ignored_any
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}

/// The elements of a sequence or an array, or the fields of a struct, which have names.
struct Elements<'a, 'de> {
    decoder: &'a mut Decoder<'de>,
    left: usize,
    names: &'static [&'static str],
}

impl Elements<'_, '_> {
    #[cold]
    fn named(&self, fault: Fault) -> Fault {
        match self.names.len().checked_sub(self.left + 1).and_then(|index| self.names.get(index)) {
            Some(name) => fault.within(name),
            None => fault,
        }
    }
}

impl<'de> SeqAccess<'de> for Elements<'_, 'de> {
    type Error = Fault;

    fn next_element_seed<S: DeserializeSeed<'de>>(&mut self, seed: S) -> Result<Option<S::Value>, Fault> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        seed.deserialize(&mut *self.decoder).map(Some).map_err(|fault| self.named(fault))
    }

    /// What memory is set aside by: exact for doubles, and never more than the bytes that are left can bear out.
    fn size_hint(&self) -> Option<usize> {
        Some(self.left.min(self.decoder.left() / 8))
    }
}
