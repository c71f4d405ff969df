//! The Python peers: their libraries installed once under `target/peers`, their scripts run from `tests/peers`.
// Each test uses a part of this.
#![allow(dead_code)]

use std::{
    ffi::OsStr,
    fs,
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, ExitStatus, Output, Stdio},
    sync::{OnceLock, mpsc},
    thread,
    time::{Duration, Instant},
};

use sha2::{Digest, Sha256};

const REQUIREMENTS: &str = include_str!("../peers/requirements.txt");

/// A Python that imports everything in `tests/peers/requirements.txt`. The first call installs it, which takes some
/// seconds and the network; later calls and later runs find it by its stamp.
pub fn python() -> PathBuf {
    static PYTHON: OnceLock<PathBuf> = OnceLock::new();
    PYTHON
        .get_or_init(|| {
            install().unwrap_or_else(|reason| {
                panic!(
                    "the tests talk to real peers written in Python, and these could not be installed: {reason}\n\
                     Needed: python3 (3.11 or newer) with either its venv module or pip, and access to PyPI \
                     (on Debian and Ubuntu: apt install python3-venv python3-pip)."
                )
            })
        })
        .clone()
}

/// `tests/peers/<script>` with its arguments, ready to run.
pub fn command<A: AsRef<OsStr>>(script: &str, args: impl IntoIterator<Item = A>) -> Command {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers").join(script);
    assert!(path.is_file(), "there is no peer script {}", path.display());
    let mut command = Command::new(python());
    command.arg(path).args(args).env("PYTHONUNBUFFERED", "1").env("PYTHONDONTWRITEBYTECODE", "1");
    command
}

/// Runs a script to its end and gives its standard output; a failing script fails the test with what it said.
pub fn run<A: AsRef<OsStr>>(script: &str, args: impl IntoIterator<Item = A>) -> String {
    let output = command(script, args).stdin(Stdio::null()).output().expect("the Python that was just installed runs");
    assert!(output.status.success(), "{script} ended with {}:\n{}", output.status, said(&output));
    String::from_utf8(output.stdout).expect("a peer script prints UTF-8")
}

/// Starts a script that goes on beside the test; it is killed when the [`Peer`] is dropped.
pub fn spawn<A: AsRef<OsStr>>(script: &str, args: impl IntoIterator<Item = A>) -> Peer {
    let mut child = command(script, args)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::inherit())
        .spawn()
        .expect("the Python that was just installed runs");
    let stdout = child.stdout.take().expect("stdout was asked for");
    let (sender, lines) = mpsc::channel();
    thread::spawn(move || forward(stdout, &sender));
    Peer { script: script.to_owned(), child, lines }
}

/// A script that runs beside the test.
pub struct Peer {
    script: String,
    child: Child,
    lines: mpsc::Receiver<String>,
}

impl Peer {
    /// The script's process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The next line that the script prints; fails the test when none comes in time.
    pub fn line(&mut self, within: Duration) -> String {
        match self.lines.recv_timeout(within) {
            Ok(line) => line,
            Err(mpsc::RecvTimeoutError::Timeout) => panic!("{} printed nothing within {within:?}", self.script),
            Err(mpsc::RecvTimeoutError::Disconnected) => {
                let status = self.wait(within);
                panic!("{} ended with {status} where a line was awaited", self.script)
            }
        }
    }

    /// The next line, or none in this time.
    pub fn line_within(&mut self, within: Duration) -> Option<String> {
        self.lines.recv_timeout(within).ok()
    }

    /// The next line that begins so, passing over others; fails the test when none comes in time.
    pub fn line_starting(&mut self, start: &str, within: Duration) -> String {
        let until = Instant::now() + within;
        loop {
            let line = self.line(until.saturating_duration_since(Instant::now()));
            if line.starts_with(start) {
                return line;
            }
        }
    }

    /// Writes one line to the script's standard input.
    pub fn say(&mut self, line: &str) {
        let stdin = self.child.stdin.as_mut().expect("stdin was asked for and is closed only by finish");
        writeln!(stdin, "{line}").and_then(|()| stdin.flush()).expect("the script reads its standard input");
    }

    /// Closes the script's standard input, waits for its end and gives the lines that nobody read.
    pub fn finish(mut self, within: Duration) -> Vec<String> {
        drop(self.child.stdin.take());
        let status = self.wait(within);
        let rest: Vec<String> = self.lines.iter().collect();
        assert!(status.success(), "{} ended with {status}:\n{}", self.script, rest.join("\n"));
        rest
    }

    /// Kills the script at once (SIGKILL), as a crash would.
    pub fn kill(mut self) {
        self.child.kill().expect("the script's process is ours to kill");
        self.child.wait().expect("a killed process ends");
    }

    fn wait(&mut self, within: Duration) -> ExitStatus {
        let until = Instant::now() + within;
        loop {
            if let Some(status) = self.child.try_wait().expect("a child of ours can be waited for") {
                return status;
            }
            assert!(Instant::now() < until, "{} did not end within {within:?}", self.script);
            thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // Both fail only when the script has ended already, which is what is wanted.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn forward(stdout: ChildStdout, sender: &mpsc::Sender<String>) {
    for line in BufReader::new(stdout).lines() {
        let Ok(line) = line else { return };
        if sender.send(line).is_err() {
            return;
        }
    }
}

/// Makes `target/peers` fit the requirements; only one process at a time does so.
fn install() -> Result<PathBuf, String> {
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("peers");
    fs::create_dir_all(&root).map_err(|e| format!("{}: {e}", root.display()))?;
    let lock = fs::File::create(root.join("lock")).map_err(|e| format!("{}: {e}", root.display()))?;
    lock.lock().map_err(|e| format!("{} can't be locked: {e}", root.display()))?;

    let stamp = root.join("stamp");
    let wanted: String = Sha256::digest(REQUIREMENTS).iter().map(|b| format!("{b:02x}")).collect();
    // The stamp names the Python too: a copied or moved target folder holds an environment that points elsewhere.
    if let Ok(text) = fs::read_to_string(&stamp)
        && let Some((hash, python)) = text.split_once('\n')
        && hash == wanted
        && Path::new(python).starts_with(&root)
        && Path::new(python).is_file()
    {
        return Ok(PathBuf::from(python));
    }
    // Gone first, so that an interrupted installation is not taken for a finished one.
    let _ = fs::remove_file(&stamp);
    let python = in_venv(&root).or_else(|venv| in_folder(&root).map_err(|pip| format!("{venv}; {pip}")))?;
    fs::write(&stamp, format!("{wanted}\n{}", python.display())).map_err(|e| format!("{}: {e}", stamp.display()))?;
    Ok(python)
}

fn in_venv(root: &Path) -> Result<PathBuf, String> {
    let venv = root.join("venv");
    let python = venv.join("bin/python");
    step(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&venv))?;
    step(Command::new(&python).args(["-m", "pip", "install", "--quiet", "-r"]).arg(requirements()))?;
    Ok(python)
}

/// Without `ensurepip` (Debian puts it in a package of its own) there is no venv with pip, but pip may be there.
fn in_folder(root: &Path) -> Result<PathBuf, String> {
    let site = root.join("site");
    let _ = fs::remove_dir_all(&site);
    step(
        Command::new("python3")
            .args(["-m", "pip", "install", "--quiet", "--target"])
            .arg(&site)
            .arg("-r")
            .arg(requirements()),
    )?;
    let python = root.join("python");
    let script = format!("#!/bin/sh\nPYTHONPATH='{}' exec python3 \"$@\"\n", site.display());
    fs::write(&python, script).map_err(|e| format!("{}: {e}", python.display()))?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        fs::set_permissions(&python, fs::Permissions::from_mode(0o755))
            .map_err(|e| format!("{}: {e}", python.display()))?;
    }
    Ok(python)
}

fn requirements() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/requirements.txt")
}

fn step(command: &mut Command) -> Result<(), String> {
    let shown = format!("{command:?}").replace('"', "");
    let output = command.stdin(Stdio::null()).output().map_err(|e| format!("{shown}: {e}"))?;
    if output.status.success() {
        Ok(())
    } else {
        Err(format!("{shown} ended with {}: {}", output.status, said(&output)))
    }
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[output.stdout.as_slice(), output.stderr.as_slice()].concat()).into_owned()
}

#[test]
fn peers_are_installed_as_pinned() {
    let printed = run("versions.py", [requirements()]);
    let missing: Vec<&str> = printed.lines().filter(|line| !line.starts_with("ok ")).collect();
    assert!(missing.is_empty(), "{missing:?}");
    assert_eq!(printed.lines().count(), REQUIREMENTS.lines().filter(|line| line.contains("==")).count());
}
