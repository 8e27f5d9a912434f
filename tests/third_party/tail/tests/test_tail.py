from pathlib import Path

import pytest
from acme_tail import TailSink

from measure.testing import SinkConformance


class TestTail(SinkConformance):
    plugin = TailSink
    address = "poses.txt"

    @pytest.fixture(autouse=True)
    def _in_a_folder_of_its_own(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)

    def test_lines_are_what_was_measured(self):
        sink = self.build()
        sink.open()
        for pose in self.poses():
            sink.send(pose)
        sink.close()
        lines = Path(self.address).read_text("utf-8").splitlines()
        place = self.poses()[0].pose.world_from_body.translation
        assert [line.split()[0] for line in lines] == ["1.000000", "1.100000"]
        assert [float(word) for word in lines[0].split()[-3:]] == pytest.approx(place, abs=1e-3)
