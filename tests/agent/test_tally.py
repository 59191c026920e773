"""What an agent reports of itself."""

import subprocess
import sys

import numpy as np

from magic_agent.tally import peak_rss_bytes


def test_peak_memory_is_this_process_s_own_and_not_its_parent_s():
    held = np.ones(100_000_000)  # 800 MB that the child does not have
    code = "from magic_agent.tally import peak_rss_bytes; print(peak_rss_bytes())"
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert peak_rss_bytes() > held.nbytes
    assert 10_000_000 < int(printed) < held.nbytes
