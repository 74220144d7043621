"""The indexer method: IMU-to-axes mounting angles of a two-axis rotating INS."""

from pathlib import Path

from alidade.pipelines.methods import Method, deferred
from alidade.pipelines.methods.indexer.parameters import PARAMETERS
from alidade.pipelines.methods.indexer.recording import (
    REQUIREMENTS,
    TOPICS,
    IndexerConfig,
    IndexerData,
    indexer_topics,
    read_indexer,
)

METHOD = Method(
    name="indexer",
    title="Indexer",
    data=IndexerData,
    topics=TOPICS,
    config_section=IndexerConfig,
    requirements=REQUIREMENTS,
    read=read_indexer,
    to_topics=indexer_topics,
    parameters=PARAMETERS,
    problem=deferred("alidade.pipelines.methods.indexer.model:problem"),
    published=deferred("alidade.pipelines.methods.indexer.published:published_estimate"),
    simulator=deferred("alidade.pipelines.methods.indexer.simulation:SIMULATOR"),
    guidance=deferred("alidade.pipelines.methods.indexer.guidance:GUIDANCE"),
    faults=deferred("alidade.pipelines.methods.indexer.guidance:FAULTS"),
    report=deferred("alidade.pipelines.methods.indexer.report:REPORT"),
    frames=Path(__file__).with_name("frames.svg"),
)
