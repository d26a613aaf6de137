-- Writes damaged segments anew, payloads and headers; their positions and times of recording stay as they are.
--
-- Each must follow what is before it in its stream, by its hash, and must be what comes after it demands: the segment
-- that follows, by that one's hash, the stream's head, or the end of a run below a base. Several that lie side by side are given together. So nothing
-- but the bytes that were there gets in here.
-- Errors: VA008, nothing is changed.
create function repair_segments(
  p_position bigint[], p_first_sequence bigint[], p_event_count integer[], p_schema_version integer[],
  p_time_min timestamptz[], p_time_max timestamptz[], p_producer text[], p_version text[], p_configuration bytea[],
  p_payload bytea[], p_payload_hash bytea[], p_chain_hash bytea[]
) returns void
language plpgsql security definer set search_path from current as $$
declare
  r           segments;
  following   segments;
  s           streams;
  last        bigint;
  before      bytea;
  is_demanded boolean;
  written     bigint;
begin
  update archive_head set is_rewriting = true;
  update segments g set first_sequence = u.fs, event_count = u.ec, schema_version = u.sv, time_min = u.tmin,
      time_max = u.tmax, producer = u.pr, producer_version = u.ve, configuration_hash = u.co, payload = u.pl,
      payload_hash = u.ph, chain_hash = u.ch
    from unnest(p_position, p_first_sequence, p_event_count, p_schema_version, p_time_min, p_time_max, p_producer,
      p_version, p_configuration, p_payload, p_payload_hash, p_chain_hash)
      as u(po, fs, ec, sv, tmin, tmax, pr, ve, co, pl, ph, ch)
    where g.position = u.po;
  get diagnostics written = row_count;
  if written <> cardinality(p_position) then
    raise exception 'of positions % only % are here; what is sealed is not repaired here', p_position, written
      using errcode = 'VA008';
  end if;
  for r in select * from segments where position = any(p_position) order by position loop
    select * into strict s from streams where id = r.stream_id;
    last := r.first_sequence + r.event_count - 1;
    before := case when r.first_sequence = 1 then decode(repeat('00', 32), 'hex') end;
    if before is null then
      select g.chain_hash into before from segments g
        where g.stream_id = r.stream_id and g.first_sequence < r.first_sequence
          and g.first_sequence + g.event_count = r.first_sequence
        order by g.first_sequence desc limit 1;
    end if;
    if before is null then
      select e.chain_hash into before from sealed_ranges e
        where e.stream_id = r.stream_id and e.last_sequence = r.first_sequence - 1;
    end if;
    if before is null then
      select b.chain_hash into before from stream_bases b
        where b.stream_id = r.stream_id and b.sequence = r.first_sequence - 1;
    end if;
    select * into following from segments g where g.stream_id = r.stream_id and g.first_sequence = last + 1;
    if found then
      is_demanded := sha256(r.chain_hash || segment_header(s.epoch, s.station, s.source, s.type,
        following.first_sequence, following.event_count, following.schema_version, following.time_min,
        following.time_max, following.producer, following.producer_version, following.configuration_hash)
        || following.payload_hash) = following.chain_hash;
    else
      is_demanded := (s.sequence = last and s.chain_hash = r.chain_hash) or exists (select from stream_bases b
        where b.stream_id = r.stream_id and b.filled_sequence = last and b.filled_hash = r.chain_hash);
    end if;
    if sha256(r.payload) is distinct from r.payload_hash or is_demanded is not true
        or sha256(before || segment_header(s.epoch, s.station, s.source, s.type, r.first_sequence, r.event_count,
          r.schema_version, r.time_min, r.time_max, r.producer, r.producer_version, r.configuration_hash)
          || r.payload_hash) is distinct from r.chain_hash then
      raise exception 'position % cannot be what it is to become: its neighbours'' hashes say otherwise', r.position
        using errcode = 'VA008';
    end if;
  end loop;
  update archive_head set is_rewriting = false;
end $$;
