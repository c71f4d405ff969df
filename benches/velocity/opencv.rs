//! OpenCV's Lucas–Kanade and DIS in place of a network: `benches/rivals/velocity.py` over pipes.

use std::{
    io::{Read, Write},
    path::Path,
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
};

use nightflow::flow::{Error, Model, Network, Raster, Slot, padding::Padded};

use super::rivals::python;

/// Methods that the rival knows.
pub const METHODS: [&str; 2] = ["lk", "dis"];

/// The rival and the frames that it is to look at.
pub struct OpenCv {
    child: Child,
    to: ChildStdin,
    from: ChildStdout,
    size: [usize; 2],
    frames: [Vec<u8>; 2],
    rgb: Vec<f32>,
    model: Model,
}

impl OpenCv {
    /// Starts the rival.
    pub fn open(method: &str) -> Result<Self, String> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/rivals/velocity.py");
        let mut command = Command::new(python()?);
        command.arg(script).arg(method).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().map_err(|error| error.to_string())?;
        let (Some(to), Some(from)) = (child.stdin.take(), child.stdout.take()) else { return Err("no pipes".into()) };
        let model = Model { name: method.into(), ..Model::default() };
        Ok(Self { child, to, from, size: [0; 2], frames: Default::default(), rgb: vec![], model })
    }

    fn ask(&mut self, older: Slot, out: &mut Raster<'_>) -> std::io::Result<()> {
        for side in self.size {
            self.to.write_all(&(side as u32).to_le_bytes())?;
        }
        self.to.write_all(&self.frames[older.index()])?;
        self.to.write_all(&self.frames[older.other().index()])?;
        self.to.flush()?;
        for values in [&mut *out.flow, &mut *out.uncertainty] {
            let mut bytes = vec![0; 4 * values.len()];
            self.from.read_exact(&mut bytes)?;
            for (value, four) in values.iter_mut().zip(bytes.as_chunks::<4>().0) {
                *value = f32::from_le_bytes(*four);
            }
        }
        Ok(())
    }
}

impl Network for OpenCv {
    fn stride(&self) -> usize {
        4
    }

    fn describe(&mut self, slot: Slot, image: &Padded<'_>) -> Result<(), Error> {
        let pixels = image.width * image.height;
        self.size = [image.width, image.height];
        self.rgb.resize(3 * pixels, 0.0);
        image.write(&mut self.rgb);
        let grey = |at: usize| {
            let [red, green, blue] = [0, 1, 2].map(|colour| self.rgb[colour * pixels + at]);
            (255.0 * (0.299 * red + 0.587 * green + 0.114 * blue)).round() as u8
        };
        self.frames[slot.index()] = (0..pixels).map(grey).collect();
        Ok(())
    }

    fn between(&mut self, older: Slot, scale: [f32; 2], mut out: Raster<'_>) -> Result<(), Error> {
        let failed = |error: std::io::Error| Error::Session { doing: "ask OpenCV", reason: error.to_string() };
        self.ask(older, &mut out).map_err(failed)?;
        for [u, v] in out.flow.as_chunks_mut::<2>().0 {
            (*u, *v) = (*u * scale[0], *v * scale[1]);
        }
        Ok(())
    }

    fn model(&self) -> &Model {
        &self.model
    }
}

impl Drop for OpenCv {
    fn drop(&mut self) {
        // Its input ends with this process at the latest; nobody waits for what it has to say any more.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
