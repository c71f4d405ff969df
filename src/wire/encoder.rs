//! CDR out: any of our structs becomes XCDR version 1, little-endian, as ROS 2 puts it on every wire.

use serde::{
    Serialize,
    ser::{self, Impossible, SerializeSeq, SerializeStruct, SerializeTuple},
};

/// The encapsulation header: XCDR1, little-endian, no options.
pub(super) const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Why a value has no CDR form.
#[derive(Debug)]
pub(super) struct Refusal(pub String);

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Refusal {}

impl ser::Error for Refusal {
    fn custom<T: std::fmt::Display>(message: T) -> Self {
        Self(message.to_string())
    }
}

/// Replaces what `out` holds by the header and the value; what `out` has allocated is used again.
pub(super) fn encode<T: Serialize>(value: &T, out: &mut Vec<u8>) -> Result<(), Refusal> {
    out.clear();
    out.extend_from_slice(&HEADER);
    value.serialize(&mut Encoder { out })
}

struct Encoder<'a> {
    out: &'a mut Vec<u8>,
}

impl Encoder<'_> {
    /// Alignment counts from the end of the header.
    fn align(&mut self, to: usize) {
        let past = (self.out.len() - HEADER.len()) % to;
        if past != 0 {
            self.out.resize(self.out.len() + to - past, 0);
        }
    }

    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        self.align(N);
        self.out.extend_from_slice(&bytes);
    }

    fn length(&mut self, length: usize, of: &str) -> Result<(), Refusal> {
        let length = u32::try_from(length).map_err(|_| {
            Refusal(format!("at most {} {of}, which is what CDR can count, but there are {length}", u32::MAX))
        })?;
        self.number(length.to_le_bytes());
        Ok(())
    }
}

fn no_form<T>(what: &str) -> Result<T, Refusal> {
    Err(Refusal(format!("a type that ROS 2 messages have, but {what} is not one")))
}

macro_rules! numbers {
    ($($method:ident $number:ty),*) => {$(
        fn $method(self, value: $number) -> Result<(), Refusal> {
            self.number(value.to_le_bytes());
            Ok(())
        }
    )*};
}

impl<'e, 'a> ser::Serializer for &'e mut Encoder<'a> {
    type Ok = ();
    type Error = Refusal;
    type SerializeSeq = Self;
    type SerializeTuple = Self;
    type SerializeTupleStruct = Impossible<(), Refusal>;
    type SerializeTupleVariant = Impossible<(), Refusal>;
    type SerializeMap = Impossible<(), Refusal>;
    type SerializeStruct = Self;
    type SerializeStructVariant = Impossible<(), Refusal>;

    numbers!(
        serialize_i8 i8, serialize_i16 i16, serialize_i32 i32, serialize_i64 i64,
        serialize_u8 u8, serialize_u16 u16, serialize_u32 u32, serialize_u64 u64,
        serialize_f32 f32, serialize_f64 f64
    );

    fn serialize_bool(self, value: bool) -> Result<(), Refusal> {
        self.out.push(u8::from(value));
        Ok(())
    }

    /// The length counts the terminating zero.
    fn serialize_str(self, value: &str) -> Result<(), Refusal> {
        if let Some(at) = value.bytes().position(|byte| byte == 0) {
            return Err(Refusal(format!("text without a zero character, but there is one at {at}")));
        }
        self.length(value.len() + 1, "characters")?;
        self.out.extend_from_slice(value.as_bytes());
        self.out.push(0);
        Ok(())
    }

    fn serialize_bytes(self, value: &[u8]) -> Result<(), Refusal> {
        self.length(value.len(), "bytes")?;
        self.out.extend_from_slice(value);
        Ok(())
    }

    fn serialize_seq(self, length: Option<usize>) -> Result<Self, Refusal> {
        match length {
            Some(length) => self.length(length, "elements")?,
            None => return no_form("a sequence of unknown length"),
        }
        Ok(self)
    }

    fn serialize_tuple(self, _length: usize) -> Result<Self, Refusal> {
        Ok(self)
    }

    fn serialize_struct(self, _name: &'static str, _length: usize) -> Result<Self, Refusal> {
        Ok(self)
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _name: &'static str, value: &T) -> Result<(), Refusal> {
        value.serialize(self)
    }

    fn serialize_char(self, _value: char) -> Result<(), Refusal> {
        no_form("a character")
    }

    fn serialize_none(self) -> Result<(), Refusal> {
        no_form("an option")
    }

    fn serialize_some<T: Serialize + ?Sized>(self, _value: &T) -> Result<(), Refusal> {
        no_form("an option")
    }

    fn serialize_unit(self) -> Result<(), Refusal> {
        no_form("a unit")
    }

    fn serialize_unit_struct(self, _name: &'static str) -> Result<(), Refusal> {
        no_form("a unit")
    }

    fn serialize_unit_variant(self, _: &'static str, _: u32, _: &'static str) -> Result<(), Refusal> {
        no_form("an enum")
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: &T,
    ) -> Result<(), Refusal> {
        no_form("an enum")
    }

    fn serialize_tuple_struct(self, _: &'static str, _: usize) -> Result<Self::SerializeTupleStruct, Refusal> {
        no_form("a tuple struct")
    }

    fn serialize_tuple_variant(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeTupleVariant, Refusal> {
        no_form("an enum")
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Self::SerializeMap, Refusal> {
        no_form("a map")
    }

    fn serialize_struct_variant(
        self,
        _: &'static str,
        _: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self::SerializeStructVariant, Refusal> {
        no_form("an enum")
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}

impl SerializeSeq for &mut Encoder<'_> {
    type Ok = ();
    type Error = Refusal;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Refusal> {
        value.serialize(&mut **self)
    }

    fn end(self) -> Result<(), Refusal> {
        Ok(())
    }
}

impl SerializeTuple for &mut Encoder<'_> {
    type Ok = ();
    type Error = Refusal;

    fn serialize_element<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Refusal> {
        value.serialize(&mut **self)
    }

    fn end(self) -> Result<(), Refusal> {
        Ok(())
    }
}

impl SerializeStruct for &mut Encoder<'_> {
    type Ok = ();
    type Error = Refusal;

    fn serialize_field<T: Serialize + ?Sized>(&mut self, name: &'static str, value: &T) -> Result<(), Refusal> {
        value.serialize(&mut **self).map_err(|Refusal(reason)| Refusal(format!("{name}: {reason}")))
    }

    fn end(self) -> Result<(), Refusal> {
        Ok(())
    }
}
