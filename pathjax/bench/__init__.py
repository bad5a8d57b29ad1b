"""Speed against error, beside a peer in the same run."""
