//! Reads dappled's slices: cargo run --release -- ENDPOINT
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let endpoint = std::env::args().nth(1).ok_or("usage: reader ENDPOINT")?;
    let stream = zmq::Context::new().socket(zmq::SUB)?;
    stream.set_rcvhwm(8)?; // so many messages may wait here; the default of 1000 would be gigabytes
    stream.set_subscribe(b"slices")?;
    stream.set_subscribe(b"end")?;
    stream.connect(&endpoint)?;

    let mut expected = None;
    loop {
        let parts = stream.recv_multipart(0)?;
        let header: serde_json::Value = serde_json::from_slice(&parts[1])?;
        if parts[0] == b"end" {
            return Ok(());
        }
        let seq = header["seq"].as_u64().ok_or("no seq")?;
        if let Some(wanted) = expected.filter(|wanted| *wanted != seq) {
            eprintln!("missed {} messages", seq - wanted);
        }
        expected = Some(seq + 1);
        let array = &header["arrays"][0]; // slices: complex64 (K, h, w), little endian, C order
        let shape: Vec<usize> = serde_json::from_value(array["shape"].clone())?;
        let (body, pixels) = (&parts[2], shape[1] * shape[2]);
        if array["dtype"] != "<c8" || body.len() != 8 * shape[0] * pixels {
            return Err("header and body disagree".into());
        }
        let real = |i: usize| f32::from_le_bytes(body[8 * i..8 * i + 4].try_into().unwrap()) as f64;
        let mean = (0..pixels).map(real).sum::<f64>() / pixels as f64;
        let (frame, name) = (&header["frame"], array["name"].as_str().unwrap_or(""));
        println!("frame {frame} {name} {}x{}x{} mean {mean:.6}", shape[0], shape[1], shape[2]);
    }
}
