from acme_blob import BlobDetector

from measure.testing import DetectorConformance


class TestBlob(DetectorConformance):
    plugin = BlobDetector
