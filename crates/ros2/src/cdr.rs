//! CDR, the encoding of ROS 2 messages.
//!
//! Little-endian plain CDR (XCDR1) as ROS 2 writes it: four bytes of header, then fields aligned to their size, counted from behind the header
//! (OMG DDSI-RTPS 10.2). Text is its length with the closing zero, its bytes, the zero; a sequence is its length and its elements.

/// What stands before every message: plain CDR, little-endian, no options.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A cursor on one message; `None` = it ends too early or is not such a message.
pub(crate) struct Reader<'a> {
    body: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub fn new(message: &'a [u8]) -> Option<Self> {
        let (header, body) = message.split_at_checked(HEADER.len())?;
        // The options may say how many bytes pad the end.
        (header[..2] == HEADER[..2]).then_some(Self { body, at: 0 })
    }

    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.at = self.at.next_multiple_of(N);
        let bytes = self.body.get(self.at..self.at + N)?.try_into().ok()?;
        self.at += N;
        Some(bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    pub fn f32(&mut self) -> Option<f64> {
        self.bytes().map(|b| f64::from(f32::from_le_bytes(b)))
    }

    pub fn numbers<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.bytes()?);
        }
        Some(values)
    }

    pub fn skip_text(&mut self) -> Option<()> {
        let length = usize::try_from(self.u32()?).ok()?;
        self.at = self.at.checked_add(length).filter(|end| *end <= self.body.len())?;
        Some(())
    }

    /// std_msgs/Header: stamp, ns.
    pub fn header(&mut self) -> Option<i64> {
        let (seconds, nanoseconds) = (self.u32()? as i32, self.u32()?);
        self.skip_text()?;
        Some(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds))
    }
}

/// A message that is being written.
pub(crate) struct Writer {
    bytes: Vec<u8>,
}

impl Writer {
    pub fn new() -> Self {
        Self { bytes: HEADER.to_vec() }
    }

    /// The message.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        let end = (self.bytes.len() - HEADER.len()).next_multiple_of(N);
        self.bytes.resize(HEADER.len() + end, 0);
        self.bytes.extend(bytes);
    }

    pub fn u8(&mut self, value: u8) {
        self.put([value]);
    }

    pub fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    pub fn f64(&mut self, value: f64) {
        self.put(value.to_le_bytes());
    }

    /// Text; a zero in it, which would end it for every reader, is left out.
    pub fn text(&mut self, text: &str) {
        let bytes: Vec<u8> = text.bytes().filter(|byte| *byte != 0).chain([0]).collect();
        self.length(bytes.len());
        self.bytes.extend(bytes);
    }

    /// Length of a sequence, before its elements.
    pub fn length(&mut self, elements: usize) {
        self.u32(u32::try_from(elements).expect("no message here has so many elements; this is a bug"));
    }

    /// std_msgs/Header of no frame. Seconds beyond 2038 wrap, as ROS has 32 bits for them.
    pub fn header(&mut self, stamp_ns: i64) {
        self.u32(stamp_ns.div_euclid(1_000_000_000) as u32);
        self.u32(stamp_ns.rem_euclid(1_000_000_000) as u32);
        self.text("");
    }
}
