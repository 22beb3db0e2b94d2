//! Messages in pieces, for networks that carry several: a large field is sent and read where it lies.

use std::collections::VecDeque;

use bytes::{Buf, Bytes, BytesMut};
use prost::Message;
use prost::encoding::{WireType, encode_key, encode_varint};

/// The bytes of a message up to those of its field `tag`, which is empty in `rest` and of which `length` bytes follow: readers take fields in any order.
pub fn head(rest: &impl Message, tag: u32, length: usize) -> Vec<u8> {
    let mut head = rest.encode_to_vec();
    encode_key(tag, WireType::LengthDelimited, &mut head);
    encode_varint(length as u64, &mut head);
    head
}

/// Bytes in pieces. A field that lies within one of them is not copied by [`Message::decode`].
#[derive(Clone, Debug, Default)]
pub struct Pieces {
    /// None is empty.
    pieces: VecDeque<Bytes>,
    remaining: usize,
}

impl Pieces {
    /// The first `count` pieces of `owner`, which they keep.
    pub fn lent<T: Clone + Send + Sync + 'static>(owner: &T, count: usize, piece: fn(&T, usize) -> &[u8]) -> Self {
        struct Lender<T> {
            owner: T,
            at: usize,
            piece: fn(&T, usize) -> &[u8],
        }
        impl<T> AsRef<[u8]> for Lender<T> {
            fn as_ref(&self) -> &[u8] {
                (self.piece)(&self.owner, self.at)
            }
        }
        (0..count).map(|at| Bytes::from_owner(Lender { owner: owner.clone(), at, piece })).collect()
    }
}

impl FromIterator<Bytes> for Pieces {
    fn from_iter<I: IntoIterator<Item = Bytes>>(pieces: I) -> Self {
        let pieces: VecDeque<Bytes> = pieces.into_iter().filter(|piece| !piece.is_empty()).collect();
        Self { remaining: pieces.iter().map(Bytes::len).sum(), pieces }
    }
}

impl Pieces {
    /// The next bytes, at most `count`, of the first piece.
    fn take(&mut self, count: usize) -> Bytes {
        let piece = self.pieces.front_mut().expect("no more is asked for than remains; this is a bug");
        let taken = if piece.len() <= count { self.pieces.pop_front().unwrap_or_default() } else { piece.split_to(count) };
        self.remaining -= taken.len();
        taken
    }
}

impl Buf for Pieces {
    fn remaining(&self) -> usize {
        self.remaining
    }

    fn chunk(&self) -> &[u8] {
        self.pieces.front().map_or(&[], |piece| piece)
    }

    fn advance(&mut self, count: usize) {
        let mut left = count;
        while left > 0 {
            match self.pieces.front_mut() {
                Some(piece) if piece.len() > left => {
                    piece.advance(left);
                    self.remaining -= left;
                    left = 0;
                }
                _ => left -= self.take(left).len(),
            }
        }
    }

    /// Copied only where the bytes are in several pieces.
    fn copy_to_bytes(&mut self, count: usize) -> Bytes {
        if self.chunk().len() >= count {
            return if count == 0 { Bytes::new() } else { self.take(count) };
        }
        let mut copied = BytesMut::with_capacity(count);
        while copied.len() < count {
            copied.extend_from_slice(&self.take(count - copied.len()));
        }
        copied.freeze()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v1::{PredictReply, PredictRequest};

    /// Goal: a message in pieces is the message, however it is cut, and a field that is not cut is not copied. Method: each cut of a small one.
    #[test]
    fn property_pieces_are_the_message() {
        let states = Bytes::from_static(&[1, 2, 3, 4, 5, 6, 7, 8]);
        let reply = PredictReply { tag: 7, samples: 2, validity: vec![0, 9], states: states.clone(), ..PredictReply::default() };
        let rest = PredictReply { states: Bytes::new(), ..reply.clone() };
        let beginning = head(&rest, PredictReply::STATES, states.len());
        let found = PredictReply::decode(Pieces::from_iter([beginning.clone().into(), states.clone()])).unwrap();
        assert_eq!((&found, found.states.as_ptr()), (&reply, states.as_ptr()), "read where it lies");
        let whole = Bytes::from([&beginning[..], &states].concat());
        for first in 0..=whole.len() {
            for second in first..=whole.len() {
                let pieces =
                    Pieces::lent(&[whole.slice(..first), whole.slice(first..second), whole.slice(second..)], 3, |all, at| &all[at]);
                assert_eq!(pieces.remaining(), whole.len());
                assert_eq!(PredictReply::decode(pieces).unwrap(), reply);
                assert_eq!(PredictReply::decode(Pieces::from_iter([whole.slice(..first)])), PredictReply::decode(whole.slice(..first)));
            }
        }
        let request = PredictRequest { horizon: 3, controls: states.clone(), tag: 2, ..PredictRequest::default() };
        let rest = PredictRequest { controls: Bytes::new(), ..request.clone() };
        let pieces = Pieces::from_iter([head(&rest, PredictRequest::CONTROLS, states.len()).into(), states.clone()]);
        assert_eq!(PredictRequest::decode(pieces).unwrap(), request);
        // A message without the field is one too.
        let rest = PredictReply { states: Bytes::new(), ..reply };
        assert_eq!(PredictReply::decode(Pieces::from_iter([head(&rest, PredictReply::STATES, 0).into()])).unwrap(), rest);
    }
}
